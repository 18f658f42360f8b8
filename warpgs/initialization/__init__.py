"""What comes before the first step: the Gaussians and the depth that training starts from."""
