"""Detectors, the joint multi-modal VAE, and fusion in its latent space."""

from jaxsense.vae.detectors import Detector as Detector
from jaxsense.vae.detectors import Looks as Looks
from jaxsense.vae.detectors import features as features
from jaxsense.vae.detectors import retrain as retrain
from jaxsense.vae.fusion import InPlace as InPlace
from jaxsense.vae.fusion import prior as prior
from jaxsense.vae.gaussian import product_of_experts as product_of_experts
from jaxsense.vae.jmvae import Jmvae as Jmvae
from jaxsense.vae.jmvae import decode as decode
from jaxsense.vae.jmvae import encode as encode
from jaxsense.vae.jmvae import init as init
from jaxsense.vae.jmvae import log_likelihood as log_likelihood
from jaxsense.vae.jmvae import posterior as posterior
from jaxsense.vae.jmvae import train as train
from jaxsense.vae.readout import sigma_norm as sigma_norm
