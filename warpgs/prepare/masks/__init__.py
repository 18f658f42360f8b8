"""Dynamic masks: given, or found by the motion that the camera does not explain."""
