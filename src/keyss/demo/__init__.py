"""The demo: made-up scenes, one hidden in the other and opened again."""
