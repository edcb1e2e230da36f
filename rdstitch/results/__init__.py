"""What a recipe takes and gives: options, registration, stitch result, messages."""
