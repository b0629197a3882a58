"""The learned method: the key-conditioned decoder, the joint training, revealing."""
