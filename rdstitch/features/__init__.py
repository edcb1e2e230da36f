"""Features of pictures, and their matches."""
