"""The fixed failing sets of Tables 3.2 and 3.4, by exact channel names."""

from __future__ import annotations

from fusion.data.dataset import Dataset
from fusion.data.driver import (
    DRIVER_CHANNELS,
    DRIVER_SOURCE_CHANNELS,
    DRIVER_TAGGED_CHANNELS,
)
from fusion.failures import Protocol, fixed_failing

# n_clean -> channels that fail. The text names three channels where four must fail and two where
# three must; these sets follow its names and have the right sizes.
HAR_FIXED_FAILING: dict[int, tuple[str, ...]] = {
    6: ("body_acc_x", "body_gyro_x", "total_acc_x"),
    5: ("body_acc_x", "body_acc_z", "body_gyro_x", "total_acc_x"),
}
# n_clean -> channels that stay clean. The text calls the 5 and 7 names it lists corrupted, but
# their number is n_clean and the longer list scores higher, so they must be the clean ones.
_CLEAN_5 = (
    "Long_Term_Fuel_Trim_Bank1",
    "Maximum_indicated_engine_torque",
    "Calculated_LOAD_value",
    "Activation_of_Air_compressor",
    "Engine_coolant_temperature",
)
DRIVER_FIXED_CLEAN: dict[int, tuple[str, ...]] = {
    5: _CLEAN_5,
    7: (*_CLEAN_5, "Intake_air_pressure", "Fuel_consumption"),
}


def fixed_sets(dataset: Dataset) -> dict[int, tuple[str, ...]]:
    """The published fixed failing sets of a data set: n_clean -> names of failing channels.

    For the driver data the names are those of the channels at hand: a signal that was replaced
    (`DRIVER_REPLACEMENTS`) fails or stays clean in the place of the one it stands for.

    Returns:
        An empty mapping for a set without published fixed sets.
    """
    if dataset.name == "har":
        return dict(HAR_FIXED_FAILING)
    if dataset.channels in (DRIVER_CHANNELS, DRIVER_TAGGED_CHANNELS, DRIVER_SOURCE_CHANNELS):
        return {
            n: tuple(
                name
                for name, source in zip(dataset.channels, DRIVER_SOURCE_CHANNELS, strict=True)
                if source not in clean
            )
            for n, clean in DRIVER_FIXED_CLEAN.items()
        }
    return {}


def published_fixed(
    dataset: Dataset, n_clean: int, *, clean_fraction: float = 1.0 / 3.0
) -> Protocol:
    """The fixed failing set of Table 3.2 (HAR) or 3.4 (driver) as a protocol.

    Raises:
        ValueError: no set with this `n_clean` was published for the data set.

    Source: Shim (2020), Tables 3.2 and 3.4 and the text above them.
    Deviation: the source's lists contradict its counts; the sets used are those in this module.
    """
    sets = fixed_sets(dataset)
    if n_clean not in sets:
        known = sorted(sets) or "none"
        raise ValueError(
            f"n_clean={n_clean}: expected one of {known}, the fixed failing sets published for "
            f"{dataset.name!r}; name the channels with fusion.fixed_failing"
        )
    return fixed_failing(dataset.channels, sets[n_clean], clean_fraction=clean_fraction)
