"""The version of jaxsense, for the package, its runs and what is built from it."""

__version__ = "0.2.0"
