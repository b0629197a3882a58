"""What is to be seen of a secret without its key: attacks, beside the same attacks on plain models."""
