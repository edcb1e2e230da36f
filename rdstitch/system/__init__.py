"""Files and the machine: what is not about images."""
