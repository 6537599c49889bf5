"""Real servos: what their makers' data sheets say of them, in SI units, and where it was read."""

import math
from dataclasses import dataclass
from typing import Literal

KILOGRAM_FORCE = 9.80665  # N
ServoName = Literal[
    "MG90S", "MG996R", "STS3215", "XL330-M288", "XL430-W250", "AX-12A", "STS3250", "XC330-M288", "XM430-W350",
    "XM540-W270",
]  # fmt: skip
"""Name of a servo of the table, as its maker writes it."""
ServoLimits = Literal["none", ServoName]
"""Servo within whose limits a hand learns, or none."""


@dataclass(frozen=True)
class DataSheet:
    """What is promised of a servo at one supply voltage.

    Stall torque and no-load speed are two ends: none turns at its no-load speed against a load, or holds its stall
    torque for long.
    """

    maker: str
    voltage: float  # V
    stall_torque: float  # N m
    no_load_speed: float  # rad/s
    mass: float  # kg
    size: tuple[float, float, float]  # m
    price: tuple[int, int]
    """Price class: USD each, the lowest and the highest price found, rounded, without tax and shipping."""
    source: str
    """Where torque, speed, mass and size stand."""
    price_source: str
    """Where the prices stood, and when."""
    rated_torque: float | None = None
    """N m in steady work; None where no such figure was found. ROBOTIS's are what robotis.us estimates, a fifth of the
    stall torque, Feetech's are those of its data sheets."""


def kgf_cm(torque: float) -> float:
    """Return a torque in N m that a data sheet gives in kgf cm."""
    return torque * KILOGRAM_FORCE * 0.01


def per_minute(speed: float) -> float:
    """Return a speed in rad/s that a data sheet gives in revolutions per minute."""
    return speed * 2 * math.pi / 60


def seconds_for_60_degrees(seconds: float) -> float:
    """Return the speed in rad/s of a servo that turns by 60 degrees in so many seconds."""
    return math.pi / 3 / seconds


def millimetres(*size: float) -> tuple[float, float, float]:
    """Return a size (3,) in m that a data sheet gives in mm."""
    x, y, z = (side * 0.001 for side in size)
    return x, y, z


_ROBOTIS = "https://emanual.robotis.com/docs/en/dxl"
_FEETECH = "https://www.feetechrc.com"

SERVOS: dict[ServoName, DataSheet] = {
    "MG90S": DataSheet(
        "TowerPro", 4.8, kgf_cm(1.8), seconds_for_60_degrees(0.10), 0.0134, millimetres(22.8, 12.2, 28.5), (2, 4),
        "https://towerpro.com.tw/product/mg90s-3/", "AliExpress and Amazon, 2026",
    ),
    "MG996R": DataSheet(
        "TowerPro", 6.0, kgf_cm(11.0), seconds_for_60_degrees(0.14), 0.055, millimetres(40.7, 19.7, 42.9), (5, 11),
        "https://www.electronicoscaldas.com/datasheet/MG996R_Tower-Pro.pdf", "waveshare.com and jsumo.com, 2026",
    ),
    "STS3215": DataSheet(
        "Feetech", 12.0, kgf_cm(30.0), seconds_for_60_degrees(0.222), 0.055, millimetres(45.2, 24.7, 35.0), (14, 27),
        f"{_FEETECH}/525603.html (ST-3215-C018)", "alibaba.com and eckstein-shop.de, 2025 and 2026", kgf_cm(10.0),
    ),
    "XL330-M288": DataSheet(
        "ROBOTIS", 5.0, 0.52, per_minute(103), 0.018, millimetres(20.0, 34.0, 26.0), (24, 28),
        f"{_ROBOTIS}/x/xl330-m288/", "robotis.us, 2024 and 2026",
    ),
    "XL430-W250": DataSheet(
        "ROBOTIS", 11.1, 1.4, per_minute(57), 0.0572, millimetres(28.5, 46.5, 34.0), (27, 50),
        f"{_ROBOTIS}/x/xl430-w250/", "robotis.us, 2024 and 2026", 0.28,
    ),
    "AX-12A": DataSheet(
        "ROBOTIS", 12.0, 1.5, per_minute(59), 0.0546, millimetres(32.0, 50.0, 40.0), (45, 57),
        f"{_ROBOTIS}/ax/ax-12a/", "robotis.us, 2026", 0.30,
    ),
    "STS3250": DataSheet(
        "Feetech", 12.0, kgf_cm(50.0), seconds_for_60_degrees(0.133), 0.0745, millimetres(45.2, 24.7, 35.0), (46, 80),
        f"{_FEETECH}/562636.html (ST-3250-C001)", "alibaba.com and aliexpress.us, 2024 and 2026", kgf_cm(16.0),
    ),
    "XC330-M288": DataSheet(
        "ROBOTIS", 5.0, 0.93, per_minute(81), 0.023, millimetres(20.0, 34.0, 26.0), (90, 103),
        f"{_ROBOTIS}/x/xc330-m288/", "en.robotis.com and robotis.us, 2026",
    ),
    "XM430-W350": DataSheet(
        "ROBOTIS", 12.0, 4.1, per_minute(46), 0.082, millimetres(28.5, 46.5, 34.0), (270, 310),
        f"{_ROBOTIS}/x/xm430-w350/", "en.robotis.com and robotis.us, 2026", 0.82,
    ),
    "XM540-W270": DataSheet(
        "ROBOTIS", 12.0, 10.6, per_minute(30), 0.165, millimetres(33.5, 58.5, 44.0), (420, 483),
        f"{_ROBOTIS}/x/xm540-w270/", "en.robotis.com and robotis.us, 2026", 2.12,
    ),
}  # fmt: skip
"""The table of servos, cheapest first. One whose figures are not all to be found is not in it."""
