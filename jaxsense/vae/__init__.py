"""Detectors, the joint multi-modal VAE, and fusion in its latent space."""

from jaxsense.core.types import Fusion as Fusion
from jaxsense.vae.bayes import bayes_update as bayes_update
from jaxsense.vae.bayes import product_of_experts as product_of_experts
from jaxsense.vae.detectors import Classifier as Classifier
from jaxsense.vae.detectors import Detection as Detection
from jaxsense.vae.detectors import Detector as Detector
from jaxsense.vae.detectors import answer as answer
from jaxsense.vae.detectors import detect as detect
from jaxsense.vae.detectors import retrain as retrain
from jaxsense.vae.filter import Filter as Filter
from jaxsense.vae.fusion import InPlace as InPlace
from jaxsense.vae.fusion import fuse as fuse
from jaxsense.vae.fusion import prior as prior
from jaxsense.vae.gaussian import kl_divergence as kl_divergence
from jaxsense.vae.gaussian import moment_match as moment_match
from jaxsense.vae.jmvae import Jmvae as Jmvae
from jaxsense.vae.jmvae import decode as decode
from jaxsense.vae.jmvae import encode as encode
from jaxsense.vae.jmvae import init as init
from jaxsense.vae.jmvae import loss as loss
from jaxsense.vae.jmvae import posterior as posterior
from jaxsense.vae.jmvae import train as train
from jaxsense.vae.latent import nearest_class as nearest_class
from jaxsense.vae.latent import plausible_classes as plausible_classes
from jaxsense.vae.latent import sigma_norm as sigma_norm
from jaxsense.vae.readout import mixture as mixture
