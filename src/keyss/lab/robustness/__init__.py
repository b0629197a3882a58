"""Changes of a published model, and the losses of its cover and secrets."""
