"""What a reversible encoder is made of: stages of coupling blocks with a squeeze before each."""

from __future__ import annotations

import dataclasses

from fusion._checks import check_choice, check_count, check_counts, check_number


@dataclasses.dataclass(frozen=True)
class ReversibleConfig:
    """A stack of stages for every sensor; each squeezes, then runs `depths` coupling blocks.

    A squeeze by s makes channels of s neighbours along each axis: a series of T samples and c
    channels becomes T / s samples of s c channels; no number is lost or added.

    Attributes:
        squeezes: factor of each stage; the axes of a window are multiples of their product.
        channels: channels of the first stage, even. Where they are more than the samples squeezed
            into them, the others start as zeros: the map is then one to one, not onto.
        depths: blocks of each stage.
        hidden: channels within the two drives of a block.
        taps: width of the drives' convolutions along each axis.
        centred: the mean of a window is taken out of its samples and put into a channel of its own,
            so that rhythm and level do not stand in each other's way; needs the room.
        gain: what the samples are multiplied by at first; > 0.
        start: standard deviation of a drive's output at first, relative to its input's.
        recompute: gradients recompute activations, in memory that does not grow with depth; False
            stores them, which saves computing them again.
        learned: False leaves the encoder as it was drawn, for comparison.

    Raises:
        ValueError, TypeError: what cannot be built, by name and value.
    """

    squeezes: tuple[int, ...] = (4, 4)
    channels: int = 8
    depths: tuple[int, ...] = (2, 2)
    hidden: tuple[int, ...] = (8, 32)
    taps: tuple[int, ...] = (5, 3)
    centred: bool = False
    gain: float = 2.0
    start: float = 0.5
    recompute: bool = True
    learned: bool = True

    def __post_init__(self) -> None:
        """Refuse what cannot be built, by name and value."""
        check_counts("squeezes", self.squeezes)
        if not self.squeezes:
            raise ValueError("squeezes=(): expected at least one stage; give its factor, (4,)")
        for name in ("depths", "hidden", "taps"):
            check_counts(name, getattr(self, name), size=len(self.squeezes))
        check_count("channels", self.channels, 2)
        if self.channels % 2:
            raise ValueError(
                f"channels={self.channels}: expected an even number, whose halves drive each "
                "other; add one"
            )
        for name in ("gain", "start"):
            check_number(name, getattr(self, name), 0.0, above=True)
        for name in ("centred", "recompute", "learned"):
            check_choice(name, getattr(self, name), (True, False))

    @property
    def squeeze(self) -> int:
        """Samples along an axis that become one in the last stage."""
        total = 1
        for factor in self.squeezes:
            total *= factor
        return total

    def stage_channels(self, axes: int = 1) -> tuple[int, ...]:
        """Channels of each stage, for series (one axis) or images (two)."""
        widths = [self.channels]
        for factor in self.squeezes[1:]:
            widths.append(widths[-1] * factor**axes)
        return tuple(widths)
