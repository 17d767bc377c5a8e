"""Simulated controllers on real ptys: the demo and the tests are built on it."""
