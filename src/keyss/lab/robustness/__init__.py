"""Changes of a published model, and what they cost its cover and its secrets."""
