"""The families of wide scenes, and which of them no policy learns from."""

import numpy as np

FAMILIES = (
    "bottle_rack",
    "car_cabin",
    "conveyor",
    "desk",
    "dish_rack",
    "drawers",
    "fuselage",
    "greenhouse",
    "kitchen",
    "laboratory",
    "machine_tool",
    "pipes",
    "rubble",
    "scaffold",
    "stud_wall",
    "tilted_bins",
    "washing_drum",
    "workbench",
)
# Drawn before any family was written, and never again.
_drawn = np.random.default_rng(2026).choice(len(FAMILIES), size=4, replace=False)
HELD_OUT = tuple(FAMILIES[i] for i in sorted(_drawn.tolist()))
"""For validation of what was learned in the others."""
TRAINING = tuple(name for name in FAMILIES if name not in HELD_OUT)
