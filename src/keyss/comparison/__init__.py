"""Methods beside each other: what is measured of each, the record, the tables and the picture."""
