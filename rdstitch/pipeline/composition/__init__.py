"""The stages of an output: the layout whose seams hold, its canvas, and the image that is drawn on it."""
