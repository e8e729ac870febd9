"""Numbers printed by Atanasov, Wilkie, Koylazov and Krivanek, "A Multiscale Microfacet Model Based on Inverse Bin
Mapping" (2021), Tables 2 to 4: 2K maps (1K for the car wheel), a 32-core machine. Memory in megabytes, times in seconds."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Printed:
    """One column of Tables 2 and 3 for one scene."""

    method: str
    memory: str
    build: str


TABLES_2_AND_3 = {
    "shoes": (
        Printed("Inverse bin map", "36 MB", "0.2 s"),
        Printed("Yan flat", "3.2 GB", "8.2 s"),
        Printed("Yan curved", "19.3 GB", "56.6 s"),
        Printed("Inverse bin map (rough)", "36 MB", "0.3 s"),
    ),
    "kettle": (
        Printed("Inverse bin map", "36 MB", "0.3 s"),
        Printed("Yan flat", "3.4 GB", "8.4 s"),
        Printed("Yan curved", "59 GB", "241.3 s"),
        Printed("Inverse bin map (rough)", "36 MB", "0.3 s"),
    ),
}


@dataclass(frozen=True)
class PrintedBins:
    """One column of Table 4."""

    bins: int
    """Per side."""
    megabytes: dict
    """By scene."""


TABLE_4 = {
    0.0025: PrintedBins(942, {"wing_mirror": 43, "car_wheel": 15, "shoes": 40, "kettle": 42}),
    0.01: PrintedBins(235, {"wing_mirror": 37, "car_wheel": 9, "shoes": 36, "kettle": 36}),
    0.04: PrintedBins(59, {"wing_mirror": 36, "car_wheel": 9, "shoes": 36, "kettle": 36}),
    0.16: PrintedBins(15, {"wing_mirror": 36, "car_wheel": 8, "shoes": 36, "kettle": 36}),
}
"""Bin resolution and memory by flake roughness. The memory of the wing mirror includes a map of its paint's opacity."""

MEMORY_RATIO = 90
BUILD_RATIO = 30
"""Yan's flat elements over the inverse bin map, as the text of Section 6.1 puts it."""
