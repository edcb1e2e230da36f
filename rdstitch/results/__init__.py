"""What a recipe gives: registration, stitch result, poses, messages."""
