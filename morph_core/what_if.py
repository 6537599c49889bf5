"""What if phi were another: the questions to the process that runs policies, and its answers, as lines of JSON."""

import math
from statistics import NormalDist

import msgspec

CONFIDENCE = 0.95
_Z = NormalDist().inv_cdf((1 + CONFIDENCE) / 2)
"""Quantile of the standard normal distribution that belongs to CONFIDENCE."""


class Question(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", tag="question"):
    """Question of how good the policy of a checkpoint is on a design."""

    id: int
    run: str
    """Path of the run folder."""
    iteration: int
    """Iteration of the design that was changed; with the seed it fixes all randomness."""
    checkpoint: int
    """Iteration of the checkpoint that holds the policy."""
    phi: list[float]
    episodes: int
    seed: int = 0
    sampled: bool = True
    """Whether the policy's actions are drawn, or are its mean."""
    shown: bool = False
    """Whether an episode is played first, and handed over before the others are run."""


class Withdrawal(msgspec.Struct, frozen=True, tag_field="type", tag="withdrawal"):
    """Word that nobody waits for the answer to a question any more."""

    id: int


class Measured(msgspec.Struct, frozen=True, kw_only=True):
    """What a policy came to on a design, over its episodes on Hw-Phy."""

    episodes: int
    success: float
    """Share of the episodes that reached the goal; one whose simulation diverged did not."""
    success_interval: tuple[float, float]
    """Wilson's interval of the success, at 95 %."""
    episode_return: float
    return_interval: tuple[float, float]
    """Interval of the mean return, at 95 %, from its standard error."""
    reward_terms: dict[str, float]
    """Terms of the reward, summed over an episode: their means, which add up to the return."""
    milestones: dict[str, float]
    """Shares of the episodes that reached each milestone of the task."""
    diverged: int
    """Number of episodes whose simulation diverged; they count in no return."""


class Played(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", tag="played"):
    """One episode on the design, as the bytes of an npz file."""

    id: int
    episode: bytes


class Answer(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", tag="answer"):
    """What was measured."""

    id: int
    measured: Measured


class Refused(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", tag="refused"):
    """Sentence on why a question has no answer."""

    id: int
    reason: str


class Withdrawn(msgspec.Struct, frozen=True, kw_only=True, tag_field="type", tag="withdrawn"):
    """Word that a question was given up, as it was withdrawn."""

    id: int


Asked = Question | Withdrawal
Told = Played | Answer | Refused | Withdrawn

_asked, _told = msgspec.json.Decoder(Asked), msgspec.json.Decoder(Told)


def decode_asked(line: bytes) -> Asked:
    """Return what a line asks for; raise msgspec.DecodeError on anything else."""
    return _asked.decode(line)


def decode_told(line: bytes) -> Told:
    """Return what a line tells; raise msgspec.DecodeError on anything else."""
    return _told.decode(line)


def wilson_interval(successes: int, episodes: int) -> tuple[float, float]:
    """Return Wilson's score interval of a share at CONFIDENCE (Wilson 1927, Eq. 4 of Brown, Cai and DasGupta 2001).

    Unlike the interval of a normal distribution it stays inside [0, 1], and has a width where all or none succeeded.
    """
    z2, share = _Z**2, successes / episodes
    middle = (successes + z2 / 2) / (episodes + z2)
    half = _Z * math.sqrt(episodes) / (episodes + z2) * math.sqrt(share * (1 - share) + z2 / (4 * episodes))
    return max(0.0, middle - half), min(1.0, middle + half)


def mean_interval(values: list[float], mean: float) -> tuple[float, float]:
    """Return the interval of a mean at CONFIDENCE, from its standard error; of a single value it has no width."""
    if len(values) < 2:
        return mean, mean
    variance = sum((value - mean) ** 2 for value in values) / (len(values) - 1)
    half = _Z * math.sqrt(variance / len(values))
    return mean - half, mean + half
