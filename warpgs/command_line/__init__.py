"""What all commands share: parsing of options, progress bars, the version, what only some operating systems can do."""
