"""What the JMVAE is worth: ways of fusing looks compared, `python -m benchmarks.fusions`.

For each seed, detectors, JMVAE and filter are trained once, and every way of fusing gets the same
detections. All are measured in one unit, nats of the exact posterior:

- `nll K`: negative log-likelihood of the true class as the map reads it, after K looks at a PoI by
  random sensors. All Gaussian beliefs are read by the same `vae.readout`, by maximum entropy.
- `return MODALITY`: entropy that an episode of the map MDP removes from the exact posterior, minus
  `mdp.look_cost` for each look. The Q-networks of all fusions have the same architecture, settings
  and random keys, and learn from this same reward. They read class probabilities of the map
  instead of latents, whose numbers differ. So they differ only in what the map knows.
- `accuracy`, `looks` per PoI, `seconds` and `late`, the share of missions at the time limit: means
  over missions with these Q-networks and the auction of looks, in the same arenas. The class that a
  map shows is the most likely one for log-odds and filter, and the nearest one for the others.

`class log-odds` is exact Bayes on the detectors' probabilities, without a latent space. `product of
experts` divides by the map's prior, as in `examples/new_fusion.py`, and has no temperature.
`mixture of experts` keeps the moments of the equal mixture of all looks' posteriors by running
means, and so needs to count looks. The optimal return is by dynamic programming on the exact
posterior.

The table holds means over seeds, and differences from `filter`, paired by seed, with the half-width
of their 95 % intervals by Student's t.
"""
