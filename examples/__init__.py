"""Runnable examples; :mod:`examples.paper` reproduces the paper's figures and measures the peers."""
