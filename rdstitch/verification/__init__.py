"""Does a registration hold: do the pictures agree where it puts them, and could they lie elsewhere?"""
