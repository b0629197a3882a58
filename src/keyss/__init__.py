"""Hide a 3D Gaussian Splatting scene inside another one and open it only with a key."""
