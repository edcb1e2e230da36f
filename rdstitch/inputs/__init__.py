"""Images, masks and attitudes: what the user named, made ready for the stages."""
