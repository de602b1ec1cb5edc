"""Constants and display units shared by the problems, SI."""

from ponn_torch.optimal_control.problem import DisplayUnit

STANDARD_GRAVITY = 9.80665  # m/s²
SUN_GM = 1.32712440018e20  # m³/s²
ASTRONOMICAL_UNIT = 149.59787e9  # m, as rounded in the PoNN paper
DAY = 86400.0  # s
KILOMETRE = 1e3  # m

LANDING_DISPLAY = {
    "time": DisplayUnit("s"),
    "r": DisplayUnit("m"),
    "v": DisplayUnit("m/s"),
    "m": DisplayUnit("kg"),
    "cost": DisplayUnit("kg"),
    "thrust": DisplayUnit("N"),
}
