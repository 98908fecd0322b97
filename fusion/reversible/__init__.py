"""Reversible encoders of sensors: coupling blocks with an exact inverse, and what it is good for.

`fusion.encoders.encoder` builds `ReversibleEncoder` where `EncoderConfig.series` is
`"reversible"`; gate, auxiliary paths and targets read its features as those of the convolutions.
"""
