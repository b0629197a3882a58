"""What is left of a cover and of its secrets when the published model has been changed."""
