"""A trained scene for other programs: PLY files, compressed PLY files and a page that plays it."""
