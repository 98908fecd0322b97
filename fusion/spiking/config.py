"""What a spiking encoder is made of: code, layers, neurons, read-out, and how it learns."""

from __future__ import annotations

import dataclasses
from typing import Literal, get_args

from fusion._checks import check_choice, check_count, check_counts, check_number

Code = Literal["current", "contrast", "rate", "latency", "delta"]
Surrogate = Literal["fast_sigmoid", "arctan", "triangular", "straight_through"]
Reset = Literal["soft", "hard"]
Readout = Literal["counts", "membranes", "both"]
Read = Literal["last", "all"]
Learning = Literal["surrogate", "reward_stdp", "fixed"]


@dataclasses.dataclass(frozen=True)
class SpikingConfig:
    """A stack of layers of leaky integrate-and-fire neurons for every sensor.

    Time runs in steps; the first layer reads a step per sample. A layer's synapses have `taps`
    delays each and are read every `strides` steps, so that a layer with stride 4 runs at a quarter
    of the clock of the one below.

    Attributes:
        code: how samples become input, see `fusion.spiking.codes`; `"current"` injects the samples
            themselves through learned weights, `"contrast"` their changes and their level.
        widths: neurons of each layer; the last one is what is read.
        taps: delays of the synapses into each layer, in steps of the layer below.
        strides: steps of the layer below in one step of each layer, at most as many as taps.
        steps: steps that a scalar (a window of one sample) is held for.
        tau: shortest and longest membrane time constant of a layer [steps of the layer]; the
            neurons of a layer are spread between them.
        resonance: lowest and highest frequency of the first layer's neurons [cycles per step of the
            layer], spread between them; a resonating membrane answers its own rhythm. (0, 0) leaks
            only.
        learn_tau: the time constants and frequencies are trained, from that spread on.
        threshold: potential above which a neuron fires.
        adaptation: rise of the threshold with each spike; 0 for none.
        tau_adaptation: time constant of that rise [steps].
        recurrent: the last layer also hears its own spikes of the step before.
        reset: `"soft"` subtracts the threshold, `"hard"` sets the potential to zero.
        surrogate: derivative that stands in for that of the spike, see `surrogate.spike`.
        slope: steepness of the surrogate.
        readout: spike counts, mean membranes, or both side by side.
        read: whose they are, those of the `"last"` layer or of `"all"` layers.
        learning: `"surrogate"` gradients through time; `"reward_stdp"` without any, see
            `fusion.spiking.reward_stdp`; `"fixed"` leaves the encoder as it was drawn.
        stdp_rate: weight of the three-factor rule beside the loss.
        tau_stdp: time constant of the traces of spikes [steps].
        delta: change of a sample that the delta code sends, in units of the scaled sensor.
        frame: samples of one frame of the latency code.
        slow: samples that the level of the contrast code remembers.
        stepwise: synaptic currents are computed step by step rather than all at once: slower, and
            then a window fed in pieces gives the bits of one call.

    Raises:
        ValueError, TypeError: what cannot be built, by name and value.
    """

    code: Code | str = "current"
    widths: tuple[int, ...] = (16, 32)
    taps: tuple[int, ...] = (8, 4)
    strides: tuple[int, ...] = (4, 2)
    steps: int = 16
    tau: tuple[float, float] = (1.2, 8.0)
    resonance: tuple[float, float] = (0.0, 0.0)
    learn_tau: bool = True
    threshold: float = 1.0
    adaptation: float = 0.0
    tau_adaptation: float = 8.0
    recurrent: bool = False
    reset: Reset | str = "soft"
    surrogate: Surrogate | str = "fast_sigmoid"
    slope: float = 4.0
    readout: Readout | str = "counts"
    read: Read | str = "last"
    learning: Learning | str = "surrogate"
    stdp_rate: float = 1.0
    tau_stdp: float = 4.0
    delta: float = 0.05
    frame: int = 8
    slow: float = 64.0
    stepwise: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot be built, by name and value."""
        for name, options in (
            ("code", Code),
            ("surrogate", Surrogate),
            ("reset", Reset),
            ("readout", Readout),
            ("read", Read),
            ("learning", Learning),
        ):
            check_choice(name, getattr(self, name), get_args(options))
        for name in ("learn_tau", "recurrent", "stepwise"):
            check_choice(name, getattr(self, name), (True, False))
        check_counts("widths", self.widths)
        if not self.widths:
            raise ValueError("widths=(): expected at least one layer; give its neurons, (32,)")
        for name in ("taps", "strides"):
            check_counts(name, getattr(self, name), size=len(self.widths))
        for index, (taps, stride) in enumerate(zip(self.taps, self.strides, strict=True)):
            if stride > taps:
                raise ValueError(
                    f"strides[{index}]={stride}: expected at most {taps}, the taps of the layer, "
                    "or samples would be skipped; lower it or raise taps"
                )
        check_count("steps", self.steps)
        check_count("frame", self.frame, 2)
        check_number("slow", self.slow, 1.0, fix="a level needs some samples")
        for name in ("threshold", "slope", "tau_adaptation", "tau_stdp", "delta"):
            check_number(name, getattr(self, name), 0.0, above=True)
        for name in ("adaptation", "stdp_rate"):
            check_number(name, getattr(self, name), 0.0, fix="0 turns it off")
        shortest, longest = self.tau
        check_number("tau[0]", shortest, 1.0, fix="a membrane keeps at least its last step")
        check_number("tau[1]", longest, shortest, fix="give (shortest, longest)")
        slowest, fastest = self.resonance
        check_number("resonance[0]", slowest, 0.0, 0.5, fix="half a cycle a step is the fastest")
        check_number("resonance[1]", fastest, slowest, 0.5, fix="give (lowest, highest)")

    @property
    def analog(self) -> bool:
        """Whether the first layer is driven by numbers rather than spikes."""
        return self.code in ("current", "contrast")

    @property
    def stride(self) -> int:
        """Samples in one step of the last layer; a window is a multiple of it."""
        total = 1
        for stride in self.strides:
            total *= stride
        return total

    @property
    def features(self) -> int:
        """Width of the feature vector of one sensor."""
        neurons = self.widths[-1] if self.read == "last" else sum(self.widths)
        return neurons * (2 if self.readout == "both" else 1)

    def resonates(self, layer: int) -> bool:
        """Whether the membranes of a layer oscillate."""
        return layer == 0 and self.resonance[1] > 0.0
