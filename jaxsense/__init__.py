"""Coordinated multi-modal robot perception in JAX.

Robots with different sensors look at points of interest and write what they see into one shared map
of latent Gaussians. A Q-network chooses each robot's next look. After Korthals, Leitner and
Rueckert, "Coordinated Heterogeneous Distributed Perception based on Latent Space Representation",
2018. The parts are `sim` (arena, rays, sensors), `vae` (detectors, JMVAE, fusion), `dqn` (MDP,
Q-learning), `looks`, `training`, `mission` and `interfaces`. All functions are pure; those that
draw random numbers take their key first, and most work on one example: add `vmap` and `jit`.
"""

import lazy_loader

# On demand, as `__init__.pyi` says: MuJoCo takes longer to import than everything else.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
