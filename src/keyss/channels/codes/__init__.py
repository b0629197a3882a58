"""The last bits of the codes of a final .spz, .sog or compressed .ply: exact, and lost in any other file."""
