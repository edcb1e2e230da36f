"""A page to look at a Deep Zoom image: zoom and pan, outlines and names of the images, seams, what was found."""

from rdstitch.viewer.page import ViewedImage, viewer_page, viewer_path

__all__ = ["ViewedImage", "viewer_page", "viewer_path"]
