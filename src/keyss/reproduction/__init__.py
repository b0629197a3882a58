"""The tables of the KeySS paper: its figures, what is run beside them, and what its claims come to.

published.py   the figures, as data
tables.py      which runs and measures make a table, and what the paper concludes from it
claims.py      the rule by which a conclusion holds
measuring.py   the numbers of a run
scenes.py      which scenes hide which, at small scale and at the paper's
record.py      a table that was made, as JSON and as Markdown
"""
