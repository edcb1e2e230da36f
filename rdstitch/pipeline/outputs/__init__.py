"""The files that a recipe writes."""
