"""Detection by an attacker with the source code, but no key: hidden content, its identity, and count."""
