"""Export of a trained scene for other programs: PLY files, compressed PLY files, and a web page that plays it."""
