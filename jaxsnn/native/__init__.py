"""Windows of the networks S1-S4 by their spikes, in C++: `NetworkConfig(engine="native")`.

Where a matrix product goes over all inputs in every step, this goes over those that spike. The
source is compiled by the user's own compiler when a program first asks for it. It is for CPUs, for
float32 and for constants that are the same for a whole layer; everything else is refused. It has no
derivatives.
"""

from jaxsnn.native.calls import check, fire, remember

__all__ = ["check", "fire", "remember"]
