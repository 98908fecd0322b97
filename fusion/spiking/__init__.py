"""Spiking encoders of sensors: surrogate gradients, neurons, codes, layers, cost, exchange.

`fusion.encoders.encoder` builds `SpikingEncoder` where `EncoderConfig.series` is `"spiking"`; gate,
auxiliary paths and targets read its features as they read those of the convolutions.
"""
