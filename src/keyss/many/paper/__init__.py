"""The tables of the KeySS paper: its figures, what is run beside them, and which of its claims hold."""
