"""The paper's architecture with inputs, rates, poses and conditioning that work at small scale."""

from keyss.methods.keyss.designs.network import NetworkDesign

DESIGN = NetworkDesign(common_poses=0.1)
