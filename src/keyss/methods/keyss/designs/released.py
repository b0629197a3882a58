"""The authors' program, where it differs from the paper's text."""

from dataclasses import replace

from keyss.methods.keyss.designs import published

DESIGN = replace(published.DESIGN, residuals="one-sided", ssim_weight=None, at_cap="freeze", prune_by="cover")
