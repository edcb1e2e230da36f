"""Measurements of rdstitch where the truth is known, beside its peers."""
