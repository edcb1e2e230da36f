"""Worlds with known truth that tests and benchmarks share: matches, rendered drives, odd and hopeless image sets."""
