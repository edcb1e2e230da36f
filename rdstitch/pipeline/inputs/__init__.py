"""Reading what a recipe is given: the camera, the images, and those in the places of registered ones."""
