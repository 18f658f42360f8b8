"""Images for people to look at; its modules are imported by name, because depth needs no torch."""
