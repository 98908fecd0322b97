"""Spiking networks that learn to steer: LIF, reward-modulated STDP, a robot world."""

__all__: list[str] = []
