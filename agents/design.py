"""The numbers of the PID agent (:mod:`agents.pid_agent`): what its designer may choose."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES
from piavatar_envs.config import ConfigError

#: Joints above the legs: chains whose ends are free, so that their integrals can undo their errors.
ABOVE_LEGS = tuple(name for name in JOINT_NAMES[1:] if name.partition("_")[2] not in ("hip", "knee", "ankle", "foot"))


@dataclass(frozen=True)
class Design:
    """Numbers of the controller. Lengths are of a body at grid spacings of 5 cm, ``fidelity="coarse"``.

    Attributes:
        stiffness: of the joints by their strength [1/rad], see :func:`~agents.gains.gains_by_strength`.
        damping_time: ``kd / kp`` [s].
        integral_time: ``kp / ki`` [s] of the joints that have an integral; infinite for none.
        integrated: names of these joints. The integral takes away the error that is left because tissue gives way and
            holds back: above the legs, in the second half of 8 episodes of Stand, 13 degrees in neck and arms become 3
            and 10 in the spine become 5, and no episode ends. Two legs on the ground are a closed chain: errors that
            friction does not let them undo wind up the integrals of both, against each other, until a foot slips (at
            2 s after some 15 s). Theirs are for bodies whose pelvis is held.
        unloaded: factor on the gains of a leg that bears nothing [-], see :class:`~agents.gains.LoadSchedule`; one
            that bears half of the weight has 1. With 1, the default, the schedule is off, for softer legs are of no use
            (by hand, firm bones, the same episodes): of 64 of PushRecovery 27 last with 1 and with 0.75, 26 with 0.5,
            and returns are 0.1 more, give or take 0.1, and 1.2 less, give or take 2.6, of 172; of 24 of Stand, where
            both feet stay, all last with each of them and return 294.
        followed: names of the joints that follow a clip of the task; the others hold the rest pose. The balance knows
            no clip: where feet leave the ground it falls later if only ``ABOVE_LEGS`` follow (step, 4 episodes with
            impulses of 20 N s: after 3.1 instead of 1.3 s), where they stay all joints follow better (bow, 2 episodes
            without: a return of 140 instead of 120).
        support: from the ankles to the hindmost and to the foremost place of the centre of pressure that ankles can
            hold [m]. A foot that is pressed further back rolls over its heel, up to the stop of its ankle; the rest
            pose has the centre of mass just 12 mm ahead of the ankles.
        foot_width: within which ankles can hold it sideways [m].
        gain: of the balance, see :class:`~agents.balance.Balance`.
        hip_threshold, hip_gain: of the hip strategy, see :class:`~agents.balance.Balance`.
        hip_share: share of the strength of both hips that it has [-]. A body that walks is beyond the threshold all
            the time: after DeepMimic's walk it falls later without (12 episodes: after 0.6 instead of 0.4 s).
    """

    stiffness: float = 1.75
    damping_time: float = 0.06
    integral_time: float = 2.0
    integrated: tuple[str, ...] = ABOVE_LEGS
    unloaded: float = 1.0
    followed: tuple[str, ...] = JOINT_NAMES[1:]
    support: tuple[float, float] = (0.010, 0.112)
    foot_width: float = 0.04
    gain: float = 0.72
    hip_threshold: float = 0.77
    hip_gain: float = 6.0
    hip_share: float = 0.6

    def check(self) -> None:
        """Refuse what is no controller.

        Raises:
            ConfigError: a name that is no joint's, or a number out of range.
        """
        for field in fields(self):
            name, value = field.name, getattr(self, field.name)
            if name in ("integrated", "followed"):
                unknown = [joint for joint in value if joint not in JOINT_NAMES[1:]]
                if unknown:
                    raise ConfigError(
                        f"{name}: {unknown[0]!r} is not a joint; use some of {', '.join(JOINT_NAMES[1:])}"
                    )
            elif name == "integral_time":
                if not value > 0.0:
                    raise ConfigError(f"{name}={value} must be > 0 [s], or inf for no integral")
            elif not all(0.0 <= number < np.inf for number in np.atleast_1d(value)):
                raise ConfigError(f"{name}={value} must be >= 0, and finite")


#: What the numbers are by default.
DEFAULT = Design()
