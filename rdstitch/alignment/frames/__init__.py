"""The frames of images and of results: upright or as stored, whole or cut out; whose plane, and which way is up."""
