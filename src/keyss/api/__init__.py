"""The public functions, which `keyss` exports and the command line calls."""
