"""Attacks of somebody who has read the source, but has no key: is something hidden, what, and how many?"""
