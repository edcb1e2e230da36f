"""A page to look at a Deep Zoom picture: zoom and pan, outlines and names of the pictures, seams, what was found."""

from rdstitch.viewer.page import ViewedPicture, viewer_page, viewer_path

__all__ = ["ViewedPicture", "viewer_page", "viewer_path"]
