"""Does a registration hold: do the images agree where it puts them, and could they lie elsewhere?"""
