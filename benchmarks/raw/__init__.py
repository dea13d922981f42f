"""What a JMVAE needs to learn from scans themselves, and what it fails without.

`python -m benchmarks.raw` trains variants of the JMVAE on the same scans, ten seeds of each side by
side, and writes figures of every seed; `python -m benchmarks.raw.report` makes tables and pictures
of them.
"""
