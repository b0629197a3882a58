"""How a secret becomes bits and Gaussians: one folder for each method."""
