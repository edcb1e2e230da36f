"""The recipes that make an image, a camera or a trajectory out of images."""
