"""Detectors, the joint multi-modal VAE, and fusion in its latent space."""

from jaxsense.vae.detectors import Detector as Detector
from jaxsense.vae.detectors import detect as detect
from jaxsense.vae.filtering import update as update
from jaxsense.vae.fusion import fuse as fuse
from jaxsense.vae.fusion import unseen as unseen
from jaxsense.vae.fusion import write as write
from jaxsense.vae.gaussian import kl_divergence as kl_divergence
from jaxsense.vae.gaussian import moment_match as moment_match
from jaxsense.vae.jmvae import Jmvae as Jmvae
from jaxsense.vae.jmvae import decode as decode
from jaxsense.vae.jmvae import encode as encode
from jaxsense.vae.jmvae import init as init
from jaxsense.vae.jmvae import loss as loss
from jaxsense.vae.jmvae import posterior as posterior
from jaxsense.vae.jmvae import train as train
from jaxsense.vae.metrics import nearest_class as nearest_class
from jaxsense.vae.metrics import plausible_classes as plausible_classes
from jaxsense.vae.metrics import sigma_norm as sigma_norm
from jaxsense.vae.peers import bayes_update as bayes_update
from jaxsense.vae.peers import product_of_experts as product_of_experts
