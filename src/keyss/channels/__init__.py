"""Where bits can lie in a published model, and how a reader finds them again."""
