"""Attacks with the source code, but no key: is something hidden, what, and how many secrets?"""
