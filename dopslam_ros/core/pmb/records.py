"""What the compiled parts of a step hand to each other: arrays and numbers by name."""

from __future__ import annotations

from typing import NamedTuple

from dopslam_ros.core.linalg.arrays import BoolArray, FloatArray, IntArray


class Undetected(NamedTuple):
    """From where how often nothing new was detected.

    Attributes:
        looks: number of snapshots so far.
        viewpoints: (K, 2) places of the vehicle [m], those whose field of view still matters.
        viewpoint_looks: (K,) number of snapshots near each.
    """

    looks: int
    viewpoints: FloatArray
    viewpoint_looks: IntArray


class Regressions(NamedTuple):
    """What ties N landmarks out of view to A virtual anchors; see ``InactiveLandmarks``.

    Attributes:
        anchors: (N, A) track ids of the anchors, 0 where a place is not used.
        anchor_q: (N, 3 A) placements of the anchors then.
        gain: (N, 3, 3 A) dq / d anchor_q.
        q: (N, 3) placements then.
        covariance: (N, 3, 3) of q then.
        residual: (N, 3, 3) covariance of q given the anchors.
    """

    anchors: IntArray
    anchor_q: FloatArray
    gain: FloatArray
    q: FloatArray
    covariance: FloatArray
    residual: FloatArray


class Density(NamedTuple):
    """A PMB density: a Gaussian over vehicle and landmark components, the rest per landmark.

    A landmark (track) has a component for each type it may still be. The joint vector is
    [s; q_1 ... q_C], q the range and direction of a component in its own frame (see
    ``placement``); with ``coupling: marginal`` the covariance is block diagonal between steps.

    Attributes:
        mean: (n,) the vehicle's components (``layout.VEHICLE``), then q of the landmarks'.
        covariance: (n, n).
        start: (C + 1,) where the block of each component begins in the joint vector; the vehicle's
            is before the first one, the last entry is n.
        origin: (C, 3) where the frames of the components are [m].
        axes: (C, 3, 3) their axes, in columns.
        component_track: (C,) index of the track each component belongs to, ascending.
        component_type: (C,) VA or SP.
        component_weight: (C,) probability of the type, given that the track exists.
        track_id: (T,) stable ids, from 1 on (0 is the BS).
        existence: (T,) probability that the landmark exists, r.
        undetected: where landmarks never detected may still be.
        next_id: the id of the next new track.
    """

    mean: FloatArray
    covariance: FloatArray
    start: IntArray
    origin: FloatArray
    axes: FloatArray
    component_track: IntArray
    component_type: IntArray
    component_weight: FloatArray
    track_id: IntArray
    existence: FloatArray
    undetected: Undetected
    next_id: int


class Observed(NamedTuple):
    """A measurement set prepared for linear algebra.

    Components that were not measured, or are not used, get a zero innovation, zero Jacobian rows
    and unit variance: they drop out of every density without a special case.

    Attributes:
        values: (J, 6), NaN where not measured or not used.
        used: (J, 6) which components count.
        noise: (J, 6, 6) covariance R, unit where not used.
    """

    values: FloatArray
    used: BoolArray
    noise: FloatArray


class Likelihoods(NamedTuple):
    """Each path against the BS (source 0) and the components (sources 1 ... C).

    Attributes:
        ue_jacobian: (C + 1, 6, 4) A = dh/ds.
        landmark_jacobian: (C + 1, 6, 3) B = dh/dq, zero for the BS.
        detection: (C + 1,) p_D.
        innovation: (C + 1, J, 6) z - h, zero where not used.
        log_likelihood: (C + 1, J) ln N(z; h, S); -inf outside the gate.
    """

    ue_jacobian: FloatArray
    landmark_jacobian: FloatArray
    detection: FloatArray
    innovation: FloatArray
    log_likelihood: FloatArray


class Births(NamedTuple):
    """A candidate landmark of each unknown type (first axis, 2) from each path (second, J).

    Where ``log_intensity`` is -inf the rest is finite but means nothing.

    Attributes:
        position: (2, J, 3) [m].
        covariance: (2, J, 3, 3).
        gain: (2, J, 3, 4) how the position follows the vehicle: its covariance with any part y of
            the state is ``gain @ cov(s, y)``.
        log_intensity: (2, J) ln rho, the measurement intensity of undetected landmarks; -inf where
            the path cannot have come from such a landmark.
    """

    position: FloatArray
    covariance: FloatArray
    gain: FloatArray
    log_intensity: FloatArray


class LocalWeights(NamedTuple):
    """Logarithms of the local weights, eqs. (22)-(24) of Ge et al. 2022.

    Attributes:
        source: (C + 1, J) detected by path j as source (0 the BS, then components): r u p_D N.
        track: (T + 1, J) the same, summed over the types of each track; row 0 is the BS.
        missed: (T + 1,) 1 - r + r q, q the probability of a misdetection.
        new: (J,) c + rho: the path is clutter or a landmark never detected before.
    """

    source: FloatArray
    track: FloatArray
    missed: FloatArray
    new: FloatArray


class Hypotheses(NamedTuple):
    """H global hypotheses, the likeliest first.

    Attributes:
        track: (H, J) what each path was given to: 0 the BS, t + 1 track t, or NONE (clutter or
            new).
        source: (H, J) the same by component: 0 the BS, c + 1 component c, or NONE.
        weight: (H,) normalised.
        log_evidence: ln of the sum of the weights before normalisation: how well the density of
            which these are the continuations foresaw the set.
    """

    track: IntArray
    source: IntArray
    weight: FloatArray
    log_evidence: float


class Newborn(NamedTuple):
    """The landmarks that may be born from J paths.

    Attributes:
        existence: (J,) r = rho / (c + rho), where the path is given to no landmark.
        kept: (J,) whose landmark would not be pruned at once.
    """

    existence: FloatArray
    kept: BoolArray


class Ranked(NamedTuple):
    """How the paths may go with a density.

    Attributes:
        evidence: of every source.
        births: a candidate from every path.
        weights: of every pair.
        hypotheses: the best associations.
        born: births worth keeping.
        sound: whether the arithmetic went well.
    """

    evidence: Likelihoods
    births: Births
    weights: LocalWeights
    hypotheses: Hypotheses
    born: Newborn
    sound: bool


class Updated(NamedTuple):
    """The joint Gaussian under each of H hypotheses, in a form that they share.

    The updates by paths that all of them give to the same source are in ``covariance``. Each of
    the others is a branch: a run of hypotheses, taken in some order, with it has W'W less.

    Attributes:
        covariance: (n, n) P, before the branches.
        means: (H, n).
        nis: (H,) normalised innovation squared of all paths that are given away, jointly.
        place: (H,) of each hypothesis in the order of the runs.
        first: (B,) first place of the run of each branch.
        last: (B,) one beyond its last place.
        gains: (B, 6, n) W.
        sound: whether the arithmetic went well.
    """

    covariance: FloatArray
    means: FloatArray
    nis: FloatArray
    place: IntArray
    first: IntArray
    last: IntArray
    gains: FloatArray
    sound: bool


class Conditioned(NamedTuple):
    """A density given each of its H associations.

    Attributes:
        density: predicted, the births behind the rest.
        birth_track: (J,) track of the landmark born from each path, or NONE.
        updated: the joint Gaussian of that under each association.
        existence: (H, T) probability that the track exists.
        type_weight: (H, C) probability of the component's type, given that the track exists.
    """

    density: Density
    birth_track: IntArray
    updated: Updated
    existence: FloatArray
    type_weight: FloatArray


class Associations(NamedTuple):
    """Which path came from where, in terms of landmark ids; for monitors and studies.

    Attributes:
        ids: (H, J) id of the landmark (0 the BS) each path was given to, or NONE.
        weight: (H,) normalised weights.
        born: (J,) id of the landmark born from each path, or NONE.
        nis: normalised innovation squared v' S^-1 v of all paths that the likeliest hypothesis
            gives to a landmark, jointly: S has their cross terms, v is in order of the update.
        nis_dof: how many numbers these paths have; nis is 0 where it is 0, chi-squared with so
            many degrees of freedom where filter, models and hypothesis are right.
        log_evidence: ln of the sum of the hypotheses' weights before normalisation, how well the
            set was foreseen: of all paths, clutter and misdetections included.
        sources: (S,) ids of what could have been heard, the BS first.
        log_missed: (S,) ln of the probability that it is not heard.
        log_new: (J,) ln of the intensity of clutter and new landmarks at each path.
    """

    ids: IntArray
    weight: FloatArray
    born: IntArray
    nis: float
    nis_dof: int
    log_evidence: float
    sources: IntArray
    log_missed: FloatArray
    log_new: FloatArray


class Outcome(NamedTuple):
    """What a step leads to.

    Attributes:
        density: posterior.
        leaving: whether scattering points were left behind.
        associations: the hypotheses it was merged from.
        sound: whether the arithmetic went well.
    """

    density: Density
    leaving: bool
    associations: Associations
    sound: bool
