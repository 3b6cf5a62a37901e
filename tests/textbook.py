"""One step of the EK-PMB filter as one writes it down from the equations: a loop for every sum.

The oracle of the tests and the yardstick of the benchmarks: no batches, nothing shared or saved,
and nothing of the package but the declarations of inputs and parameters. It needs the path length
and an azimuth and elevation of arrival or of departure (one elevation may be missing).
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from dopslam_ros.core.models.measurements import MeasurementSet
from dopslam_ros.core.models.motion import ControlSpan
from dopslam_ros.core.pmb import FilterParameters as Parameters

Array: TypeAlias = np.ndarray
BS, VA, SP = 0, 1, 2
AZIMUTHS = (1, 3)
LOG_2PI = math.log(2.0 * math.pi)


@dataclass
class Component:
    """A landmark under the assumption that it is of one type: q = (range, two tangents)."""

    kind: int
    weight: float
    origin: Array
    axes: Array
    at: slice  # where q is in the joint mean and covariance; empty for the BS


@dataclass
class Landmark:
    """A track: its existence and what it may be."""

    id: int
    existence: float
    components: list[Component]
    path: int | None = None  # from which it is born in this step


@dataclass
class InactiveLandmark:
    """An SP out of view: q = its mean + gain (anchors - their mean) + noise."""

    landmark: Landmark
    reach: float
    place: Array
    q: Array
    covariance: Array
    anchors: list[int]  # ids of VAs
    anchors_q: Array
    gain: Array
    noise: Array


@dataclass
class Density:
    """p(s, X): a Gaussian over [s; q_1 ...], landmarks, and where nobody has looked yet."""

    mean: Array
    covariance: Array
    landmarks: list[Landmark] = field(default_factory=list)
    snapshots: int = 0
    viewpoints: list[tuple[Array, int]] = field(default_factory=list)
    next_id: int = 1
    inactive_landmarks: list[InactiveLandmark] = field(default_factory=list)


@dataclass
class Path:
    """A measured path: the components that count and their covariance."""

    z: Array
    used: list[int]
    noise: Array
    gate: float


@dataclass
class Birth:
    """A new landmark of one type, from one path."""

    kind: int
    position: Array
    covariance: Array
    gain: Array
    log_intensity: float


@dataclass
class Fit:
    """A component against all paths."""

    landmark: Landmark
    component: Component
    jacobian: Array  # of h by the whole joint state
    detection: float
    innovations: list[Array]
    log_likelihoods: list[float]


# What each path came from (None: clutter, or new), and the weight of that association.
Choice: TypeAlias = tuple[Fit | None, ...]
Hypotheses: TypeAlias = list[tuple[Choice, float]]


def start(par: Parameters) -> Density:
    """Before the first snapshot."""
    std = np.array(par.initial_std)
    return Density(np.array(par.initial_state), np.diag(std**2))


def textbook_step(
    density: Density,
    measurements: MeasurementSet,
    spans: Sequence[ControlSpan],
    speed: float,
    par: Parameters,
) -> tuple[Density, list[tuple[tuple[int | None, ...], float]]]:
    """p(s, X | Z_1:k-1) to p(s, X | Z_1:k), with the ids and weights of the associations."""
    paths = read_paths(measurements, par)
    prior = reactivate(predict(density, spans, par))
    bs = Component(BS, 1.0, np.array(par.bs_position), np.eye(3), slice(0, 0))
    known = [Landmark(0, 1.0, [bs]), *prior.landmarks]
    fits = [[weigh(prior, x, c, paths, speed, par) for c in x.components] for x in known]
    births = [[give_birth(prior, path, kind, speed, par) for kind in (VA, SP)] for path in paths]
    born = [[birth for birth in pair if birth is not None] for pair in births]
    new = [log_new(path, found, par) for path, found in zip(paths, born, strict=True)]
    hypotheses = associate(fits, new, par)
    append_births(prior, born, new, hypotheses, par)
    updated = [update(prior, paths, chosen) for chosen, _ in hypotheses]
    detection = {id(f.component): f.detection for group in fits for f in group}
    posterior = merge(prior, hypotheses, updated, detection, par)
    ids = [(tuple(f and f.landmark.id for f in chosen), weight) for chosen, weight in hypotheses]
    return deactivate(finish(posterior, par), par), ids


# --- models --------------------------------------------------------------------------------------


def wrap(angle: float) -> float:
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


def angles(v: Array) -> tuple[list[float], Array]:
    """Azimuth and elevation of a vector, and their gradients."""
    x, y, z = v
    ground, length = math.hypot(x, y), math.sqrt(x * x + y * y + z * z)
    gradient = np.array(
        [
            [-y / ground**2, x / ground**2, 0.0],
            [-z * x / (ground * length**2), -z * y / (ground * length**2), ground / length**2],
        ]
    )
    return [math.atan2(y, x), math.atan2(z, ground)], gradient


def observe(
    s: Array, speed: float, x: Array, kind: int, par: Parameters
) -> tuple[Array, Array, Array, bool]:
    """h(x, s), dh/ds (6, 4), dh/dx (6, 3), and whether vehicle and BS are on one side of a wall."""
    bs, ue = np.array(par.bs_position), np.array([s[0], s[1], par.ue_height])
    to_landmark, from_bs = x - ue, x - bs
    distance, leg = np.linalg.norm(to_landmark), np.linalg.norm(from_bs)
    arrival = to_landmark / distance
    velocity = speed * np.array([math.cos(s[2]), math.sin(s[2]), 0.0])
    turned = speed * np.array([-math.sin(s[2]), math.cos(s[2]), 0.0])
    facing, identity, nothing = True, np.eye(3), np.zeros((3, 3))
    if kind == BS:
        departure, by_ue, by_x = ue - bs, identity, nothing
    elif kind == SP:
        departure, by_ue, by_x = from_bs, nothing, identity
    else:  # towards the vehicle's mirror image behind the wall, the plane half-way from BS to VA
        offset, square = ue - 0.5 * (x + bs), from_bs @ from_bs
        share = from_bs @ offset / square
        facing = share * leg < -1e-6
        departure = ue - 2.0 * share * from_bs - bs
        by_ue = identity - 2.0 * np.outer(from_bs, from_bs) / square
        by_share = (offset - 0.5 * from_bs - 2.0 * share * from_bs) / square
        by_x = -2.0 * (share * identity + np.outer(from_bs, by_share))

    (azimuth, elevation), at_ue = angles(to_landmark)
    out, at_bs = angles(departure)
    length = distance + (leg if kind == SP else 0.0) + s[3]
    h = np.array([length, wrap(azimuth - s[2]), elevation, *out, velocity @ arrival])
    by_position = np.vstack(
        [-arrival, -at_ue, at_bs @ by_ue, -(velocity - (velocity @ arrival) * arrival) / distance]
    )
    a = np.zeros((6, 4))
    a[:, :2] = by_position[:, :2]
    a[0, 3], a[1, 2], a[5, 2] = 1.0, -1.0, turned @ arrival
    b = np.vstack([-by_position[:3], at_bs @ by_x, -by_position[5]])
    if kind == SP:
        b[0] += from_bs / leg
    return h, a, b, facing


def detection_probability(distance: float, std: float, kind: int, par: Parameters) -> float:
    """p_D; of an SP whose distance is uncertain, the expectation."""
    if kind != SP:
        return par.detection_probability
    margin = (par.sp_field_of_view - distance) / max(std, 1e-9)
    return par.detection_probability * 0.5 * math.erfc(-margin / math.sqrt(2.0))


def difference(path: Path, h: Array) -> Array:
    """z - h of the components that count."""
    return np.array(
        [wrap(path.z[i] - h[i]) if i in AZIMUTHS else path.z[i] - h[i] for i in path.used]
    )


def place(component: Component, q: Array) -> tuple[Array, Array]:
    """Where q is on the map [m], and the derivative of that."""
    tangents = np.array([1.0, q[1], q[2]])
    length = np.linalg.norm(tangents)
    local = q[0] * tangents / length
    by_q = np.zeros((3, 3))
    by_q[:, 0] = tangents / length
    for i in (1, 2):
        by_q[i, i] += q[0] / length
        by_q[:, i] -= q[0] * tangents * q[i] / length**3
    return component.origin + component.axes @ local, component.axes @ by_q


# --- prediction and local weights ----------------------------------------------------------------


def read_paths(measurements: MeasurementSet, par: Parameters) -> list[Path]:
    std = np.array(par.measurement_noise_std)
    paths = []
    for z, own in zip(measurements.values, measurements.covariances, strict=True):
        used = [i for i in range(6) if math.isfinite(z[i]) and math.isfinite(std[i])]
        noise = own if own.any() else np.diag(std**2)
        gate = float(chi2.ppf(par.gate_probability, len(used)))
        paths.append(Path(z, used, noise[np.ix_(used, used)], gate))
    return paths


def predict(density: Density, spans: Sequence[ControlSpan], par: Parameters) -> Density:
    """f of eq. (1), F P F' + Q, control by control."""
    mean, covariance = density.mean.copy(), density.covariance.copy()
    rate = np.array(par.process_noise_std) ** 2 / par.process_noise_period
    for (speed, turn), duration, *_ in spans:
        heading, turned = mean[2], turn * duration
        if abs(turned) > 1e-12:
            dx = speed / turn * (math.sin(heading + turned) - math.sin(heading))
            dy = speed / turn * (math.cos(heading) - math.cos(heading + turned))
        else:
            dx = speed * duration * math.cos(heading)
            dy = speed * duration * math.sin(heading)
        f = np.eye(len(mean))
        f[0, 2], f[1, 2] = -dy, dx
        covariance = f @ covariance @ f.T
        covariance[:4, :4] += np.diag(rate * duration)
        mean[:3] += [dx, dy, turned]
        mean[2] = wrap(mean[2])
    return replace(density, mean=mean, covariance=covariance, landmarks=list(density.landmarks))


def weigh(
    prior: Density,
    landmark: Landmark,
    component: Component,
    paths: list[Path],
    speed: float,
    par: Parameters,
) -> Fit:
    """p_D and N(z; h, S) for every path, S = H P H' + R; outside the gate the likelihood is 0."""
    x, by_q = component.origin, np.zeros((3, 0))
    if component.kind != BS:
        x, by_q = place(component, prior.mean[component.at])
    h, a, b, _ = observe(prior.mean[:4], speed, x, component.kind, par)
    away = x - np.array([*prior.mean[:2], par.ue_height])
    distance = float(np.linalg.norm(away))
    jacobian, direction = np.zeros((6, len(prior.mean))), np.zeros(len(prior.mean))
    jacobian[:, :4] = a
    jacobian[:, component.at] = b @ by_q
    direction[:2] = -away[:2] / distance
    direction[component.at] = away / distance @ by_q
    std = math.sqrt(direction @ prior.covariance @ direction)
    detection = detection_probability(distance, std, component.kind, par)
    fit = Fit(landmark, component, jacobian, detection, [], [])
    for path in paths:
        innovation, rows = difference(path, h), jacobian[path.used]
        s = rows @ prior.covariance @ rows.T + path.noise
        square = innovation @ np.linalg.solve(s, innovation)
        log_det = np.linalg.slogdet(s)[1]
        log_density = -0.5 * (square + log_det + len(path.used) * LOG_2PI)
        fit.innovations.append(innovation)
        fit.log_likelihoods.append(log_density if square <= path.gate else -math.inf)
    return fit


def log_new(path: Path, births: list[Birth], par: Parameters) -> float:
    """ln of c + rho: the path is clutter or the first one of a landmark."""
    sizes = [np.ptp(par.clutter_path_length), 2 * math.pi, math.pi, 2 * math.pi, math.pi]
    sizes.append(np.ptp(par.clutter_doppler))
    clutter = par.clutter_mean / math.prod(sizes[i] for i in path.used)
    total = clutter + sum(math.exp(birth.log_intensity) for birth in births)
    return max(math.log(total), -700.0) if total > 0.0 else -700.0


# --- birth ---------------------------------------------------------------------------------------


def first_guess(s: Array, z: Array, par: Parameters) -> Array | None:
    """Where the path was reflected: on the ray of arrival (departure), on the ellipsoid of tau."""
    bs, ue = np.array(par.bs_position), np.array([s[0], s[1], par.ue_height])
    length = z[0] - s[3]
    if not length > np.linalg.norm(bs - ue):
        return None
    if np.isfinite(z[1]) and (np.isfinite(z[2]) or not np.isfinite(z[3:5]).all()):
        focus, other, azimuth, elevation = ue, bs, z[1] + s[2], z[2]
    elif np.isfinite(z[3]):
        focus, other, azimuth, elevation = bs, ue, z[3], z[4]
    else:
        return None
    unknown = math.isnan(elevation)
    if unknown:
        elevation = 0.0
    for _ in range(10 if unknown else 1):
        ground = math.cos(elevation)
        ray = np.array(
            [ground * math.cos(azimuth), ground * math.sin(azimuth), math.sin(elevation)]
        )
        # |focus + t ray - other| = length - t
        offset = focus - other
        t = 0.5 * (length**2 - offset @ offset) / (length + ray @ offset)
        point = focus + t * ray
        rise = (par.landmark_height_mean - focus[2]) / max(t, 1.0)
        elevation = math.asin(min(max(rise, -0.9), 0.9))
    return point


def give_birth(
    prior: Density, path: Path, kind: int, speed: float, par: Parameters
) -> Birth | None:
    """Gauss-Newton from the first guess; rho by Laplace's approximation of its integral."""
    s, p = prior.mean[:4], prior.covariance[:4, :4]
    bs, ue = np.array(par.bs_position), np.array([s[0], s[1], par.ue_height])
    z = np.array([path.z[i] if i in path.used else np.nan for i in range(6)])
    x = first_guess(s, z, par)
    if x is None:
        return None
    if kind == VA:  # as far behind the wall as the BS is before it
        x = x + (x - ue) / np.linalg.norm(x - ue) * np.linalg.norm(x - bs)
    height = np.diag([1e-12, 1e-12, par.landmark_height_std**-2])
    for iteration in range(7):
        h, a, b, facing = observe(s, speed, x, kind, par)
        a, b = a[path.used], b[path.used]
        innovation = difference(path, h)
        off = np.array([0.0, 0.0, par.landmark_height_mean - x[2]])
        noise = path.noise + a @ p @ a.T
        information = b.T @ np.linalg.solve(noise, b) + height
        if iteration < 6:
            right = b.T @ np.linalg.solve(noise, innovation) + height @ off
            step = np.linalg.solve(information, right)
            x = x + step * min(1.0, 200.0 / max(np.linalg.norm(step), 1e-9))
    covariance = np.linalg.inv(information)
    away = x - ue
    distance = float(np.linalg.norm(away))
    std = math.sqrt(away @ covariance @ away) / distance
    detection = detection_probability(distance, std, kind, par)
    if np.trace(covariance) >= 200.0**2 or not facing or detection <= 0.0:
        return None
    mismatch = innovation @ np.linalg.solve(noise, innovation) + off @ height @ off
    log_intensity = (
        math.log(par.undetected_intensity)
        + log_share_left(prior, x, std, kind, par)
        + math.log(detection)
        + 0.5 * (3.0 * LOG_2PI - np.linalg.slogdet(information)[1])
        - 0.5 * (mismatch + np.linalg.slogdet(noise)[1] + len(path.used) * LOG_2PI)
    )
    gain = -covariance @ b.T @ np.linalg.solve(noise, a)
    return Birth(kind, x, covariance, gain, float(log_intensity))


def log_share_left(prior: Density, x: Array, std: float, kind: int, par: Parameters) -> float:
    """ln of the product of 1 - p_D over the snapshots that might have detected it before."""
    looks = [(prior.mean[:2], prior.snapshots)] if kind == VA else prior.viewpoints
    total = 0.0
    for viewpoint, count in looks:
        distance = float(np.linalg.norm(x - np.array([*viewpoint, par.ue_height])))
        p_d = detection_probability(distance, std, kind, par)
        total += count * math.log(1.0 - min(p_d, 1.0 - 1e-9))
    return max(total, math.log(par.undetected_floor))


def append_births(
    prior: Density,
    births: list[list[Birth]],
    new: list[float],
    hypotheses: Hypotheses,
    par: Parameters,
) -> None:
    """Adds landmarks for the paths that may be their first, correlated with the vehicle."""
    for j, candidates in enumerate(births):
        free = sum(weight for chosen, weight in hypotheses if chosen[j] is None)
        rho = sum(math.exp(birth.log_intensity) for birth in candidates)
        existence = rho / math.exp(new[j])
        if existence * free <= par.prune_existence:
            continue
        shares = [(math.exp(birth.log_intensity) / rho, birth) for birth in candidates]
        shares = [(share, birth) for share, birth in shares if share >= par.prune_type]
        whole = sum(share for share, _ in shares)
        components = [append_component(prior, birth, u / whole, par) for u, birth in shares]
        prior.landmarks.append(Landmark(prior.next_id, existence, components, path=j))
        prior.next_id += 1


def append_component(prior: Density, birth: Birth, weight: float, par: Parameters) -> Component:
    origin = np.array([*prior.mean[:2], par.ue_height])
    first = (birth.position - origin) / np.linalg.norm(birth.position - origin)
    helper = np.array([1.0, 0.0, 0.0] if abs(first[2]) > 0.9 else [0.0, 0.0, 1.0])
    second = np.cross(helper, first) / np.linalg.norm(np.cross(helper, first))
    axes = np.column_stack([first, second, np.cross(first, second)])
    n = len(prior.mean)
    component = Component(birth.kind, weight, origin, axes, slice(n, n + 3))
    # Seen along its own first axis: no tangents.
    q = np.array([np.linalg.norm(birth.position - origin), 0.0, 0.0])
    to_q = np.linalg.inv(place(component, q)[1])
    covariance = np.zeros((n + 3, n + 3))
    covariance[:n, :n] = prior.covariance
    covariance[n:, :n] = to_q @ birth.gain @ prior.covariance[:4]
    covariance[:n, n:] = covariance[n:, :n].T
    covariance[n:, n:] = to_q @ birth.covariance @ to_q.T
    prior.mean, prior.covariance = np.append(prior.mean, q), covariance
    return component


# --- associations --------------------------------------------------------------------------------


def log(x: float) -> float:
    return math.log(x) if x > 0.0 else -math.inf


def log_sum(terms: list[float]) -> float:
    largest = max(terms)
    if largest == -math.inf:
        return largest
    return largest + math.log(sum(math.exp(term - largest) for term in terms))


def associate(fits: list[list[Fit]], new: list[float], par: Parameters) -> Hypotheses:
    """The gamma best associations; ``fits`` by landmark."""
    detected = [[detections(group, j) for group in fits] for j in range(len(new))]
    cost = np.array([[missed(group) for group in fits]] * len(new)).reshape(len(new), len(fits))
    for j, i in np.ndindex(cost.shape):
        cost[j, i] -= log_sum(detected[j][i])
    candidates = []
    for columns, total in murty(cost, [-weight for weight in new], par.gamma):
        options: list[list[tuple[float, Fit | None]]] = []
        for j, i in enumerate(columns):
            shares: list[tuple[float, Fit | None]] = [(0.0, None)]
            if i is not None:
                whole = log_sum(detected[j][i])
                logs = [term - whole for term in detected[j][i]]
                shares = [s for s in zip(logs, fits[i], strict=True) if s[0] > math.log(1e-3)]
            options.append(sorted(shares, key=lambda share: -share[0]))
        # At most four landmarks split an association by type: those that are least clear.
        open_types = [j for j, shares in enumerate(options) if len(shares) > 1]
        open_types.sort(key=lambda j: -options[j][1][0])
        for j in open_types[4:]:
            options[j] = options[j][:1]
        for combination in itertools.product(*options):
            log_weight = sum(share for share, _ in combination) - total
            candidates.append((log_weight, tuple(fit for _, fit in combination)))
    best = sorted(candidates, key=lambda candidate: -candidate[0])[: par.gamma]
    total = log_sum([log_weight for log_weight, _ in best])
    return [(chosen, math.exp(log_weight - total)) for log_weight, chosen in best]


def detections(group: list[Fit], j: int) -> list[float]:
    """ln r u p_D N(z_j; h, S) of each type of a landmark."""
    r = group[0].landmark.existence
    return [log(r * f.component.weight * f.detection) + f.log_likelihoods[j] for f in group]


def missed(group: list[Fit]) -> float:
    """ln of 1 - r + r sum of u (1 - p_D)."""
    r = group[0].landmark.existence
    unseen = sum(f.component.weight * (1.0 - f.detection) for f in group)
    return max(log(1.0 - r + r * unseen), -700.0)


def murty(cost: Array, idle: list[float], k: int) -> list[tuple[list[int | None], float]]:
    """The k cheapest: take the best, forbid each of its pairs in turn, keep the pairs before it."""
    paths, landmarks = cost.shape
    own = np.full((paths, paths), np.inf)
    np.fill_diagonal(own, idle)
    whole = np.hstack([cost, own])
    queue: list[tuple[float, int, list[int], Array, int]] = []
    count = itertools.count()

    def offer(problem: Array, fixed: int) -> None:
        try:
            columns = [int(i) for i in linear_sum_assignment(problem)[1]]
        except ValueError:  # no assignment is possible
            return
        total = float(sum(whole[j, i] for j, i in enumerate(columns)))
        heapq.heappush(queue, (total, next(count), columns, problem, fixed))

    offer(whole, 0)
    ranked: list[tuple[list[int | None], float]] = []
    while queue and len(ranked) < k:
        total, _, columns, problem, fixed = heapq.heappop(queue)
        ranked.append(([i if i < landmarks else None for i in columns], total))
        for j in range(fixed, paths):
            other = problem.copy()
            other[j, columns[j]] = np.inf
            for kept in range(j):
                other[kept, np.arange(other.shape[1]) != columns[kept]] = np.inf
            offer(other, j)
    return ranked


# --- update, merge, prune ------------------------------------------------------------------------


def update(prior: Density, paths: list[Path], chosen: Choice) -> tuple[Array, Array]:
    """One joint EKF update with all the paths of an association, in Joseph's form."""
    n = len(prior.mean)
    rows, innovations, noises = [np.zeros((0, n))], [np.zeros(0)], []
    for j, (path, fit) in enumerate(zip(paths, chosen, strict=True)):
        if fit is not None:
            born_since = n - fit.jacobian.shape[1]
            rows.append(np.pad(fit.jacobian[path.used], ((0, 0), (0, born_since))))
            innovations.append(fit.innovations[j])
            noises.append(path.noise)
    if not noises:
        return prior.mean, prior.covariance
    h, r = np.vstack(rows), block_diag(*noises)
    gain = np.linalg.solve(h @ prior.covariance @ h.T + r, h @ prior.covariance).T
    left = np.eye(n) - gain @ h
    mean = prior.mean + gain @ np.concatenate(innovations)
    return mean, left @ prior.covariance @ left.T + gain @ r @ gain.T


def outcome(
    landmark: Landmark, chosen: Choice, detection: dict[int, float]
) -> tuple[float, list[float]]:
    """Existence and types of a landmark under one association."""
    parts = landmark.components
    if landmark.path is not None:
        existence = landmark.existence if chosen[landmark.path] is None else 0.0
        return existence, [c.weight for c in parts]
    for fit in chosen:
        if fit is not None and fit.landmark is landmark:
            return 1.0, [float(c is fit.component) for c in parts]
    unseen = [c.weight * (1.0 - detection[id(c)]) for c in parts]
    missed = landmark.existence * sum(unseen)
    existence = missed / max(1.0 - landmark.existence + missed, 1e-300)
    return existence, [u / max(sum(unseen), 1e-300) for u in unseen]


def merge(
    prior: Density,
    hypotheses: Hypotheses,
    updated: list[tuple[Array, Array]],
    detection: dict[int, float],
    par: Parameters,
) -> Density:
    """PMBM to PMB: moments over the associations, each block with weights of its own."""
    blocks = [(slice(0, 4), [weight for _, weight in hypotheses])]
    landmarks = []
    for landmark in prior.landmarks:
        found = [(w, *outcome(landmark, chosen, detection)) for chosen, w in hypotheses]
        parts = []
        for number, component in enumerate(landmark.components):
            weights = [w * r * types[number] for w, r, types in found]
            total = sum(weights)
            scaled = [w / total for w in weights] if total > 0.0 else blocks[0][1]
            blocks.append((component.at, scaled))
            parts.append(replace(component, weight=total))
        total = sum(c.weight for c in parts)
        for component in parts:
            component.weight /= total if total > 0.0 else 1.0
        existence = min(sum(w * r for w, r, _ in found), 1.0)
        landmarks.append(Landmark(landmark.id, existence, parts))

    mean, covariance = np.zeros_like(prior.mean), np.zeros_like(prior.covariance)
    for at, weights in blocks:
        mean[at] = sum(w * m[at] for w, (m, _) in zip(weights, updated, strict=True))
    for (a, first), (b, second) in itertools.product(blocks, blocks):
        if par.coupling == "marginal" and a != b:
            continue
        for v, w, (m, p) in zip(first, second, updated, strict=True):
            spread = np.outer(m[a] - mean[a], m[b] - mean[b])
            covariance[a, b] += math.sqrt(v * w) * (p[a, b] + spread)
    return replace(prior, mean=mean, covariance=covariance, landmarks=landmarks)


def finish(posterior: Density, par: Parameters) -> Density:
    """Drops what hardly exists, and remembers the place that one looked from."""
    landmarks = []
    for landmark in posterior.landmarks:
        if landmark.existence > par.prune_existence:
            parts = [c for c in landmark.components if c.weight > par.prune_type]
            total = sum(c.weight for c in parts)
            parts = [replace(c, weight=c.weight / total) for c in parts]
            landmarks.append(replace(landmark, components=parts))
    kept = rearrange(replace(posterior, landmarks=landmarks))
    kept.mean[2] = wrap(kept.mean[2])

    here, view = kept.mean[:2].copy(), par.sp_field_of_view
    near = [v for v in posterior.viewpoints if np.linalg.norm(v[0] - here) <= 2.0 * view][-400:]
    away = [float(np.linalg.norm(viewpoint - here)) for viewpoint, _ in near]
    if away and min(away) < 0.1 * view:
        closest = away.index(min(away))
        near[closest] = (near[closest][0], near[closest][1] + 1)
    else:
        near.append((here, 1))
    return replace(kept, snapshots=posterior.snapshots + 1, viewpoints=near)


# --- out of view ---------------------------------------------------------------------------------


def blur(density: Density) -> float:
    """How far the vehicle may be from where it seems to be."""
    return 5.0 * math.sqrt(density.covariance[0, 0] + density.covariance[1, 1])


def deactivate(density: Density, par: Parameters) -> Density:
    """Takes SPs out that cannot be detected, with their regression on the VAs that are sure."""
    anchors = [
        (landmark.id, c.at)
        for landmark in density.landmarks
        for c in landmark.components
        if c.kind == VA and landmark.existence * c.weight > 0.999
    ]
    index = [i for _, at in anchors for i in range(at.start, at.stop)]
    within = density.covariance[np.ix_(index, index)]
    active, inactive_landmarks = [], list(density.inactive_landmarks)
    for landmark in density.landmarks:
        component = landmark.components[0]
        at = component.at
        x, by_q = place(component, density.mean[at])
        covariance = density.covariance[at, at]
        reach = par.sp_field_of_view + 5.0 * math.sqrt(np.trace(by_q @ covariance @ by_q.T))
        distance = math.hypot(*(x[:2] - density.mean[:2]))
        far = distance > reach + blur(density) + 0.1 * par.sp_field_of_view
        if len(landmark.components) > 1 or component.kind != SP or not far:
            active.append(landmark)
        elif landmark.existence >= 0.05:
            cross = density.covariance[at, index]
            gain = np.linalg.solve(within, cross.T).T
            then = (density.mean[at], covariance, [number for number, _ in anchors])
            noise = covariance - gain @ cross.T
            inactive_landmarks.append(
                InactiveLandmark(landmark, reach, x, *then, density.mean[index], gain, noise)
            )
    return rearrange(replace(density, landmarks=active, inactive_landmarks=inactive_landmarks))


def rearrange(density: Density) -> Density:
    """Mean and covariance of the landmarks that are still there, one after the other."""
    keep, landmarks = [0, 1, 2, 3], []
    for landmark in density.landmarks:
        parts = []
        for component in landmark.components:
            keep += range(component.at.start, component.at.stop)
            parts.append(replace(component, at=slice(len(keep) - 3, len(keep))))
        landmarks.append(replace(landmark, components=parts))
    mean, covariance = density.mean[keep], density.covariance[np.ix_(keep, keep)]
    return replace(density, mean=mean, covariance=covariance, landmarks=landmarks)


def reactivate(density: Density) -> Density:
    """Brings SPs back that may be detected, as the VAs they depend on have it now."""
    vas = {x.id: c.at for x in density.landmarks for c in x.components if c.kind == VA}
    before = len(density.mean)
    blocks, inactive_landmarks, landmarks = [], [], list(density.landmarks)
    for inactive in density.inactive_landmarks:
        if math.hypot(*(inactive.place[:2] - density.mean[:2])) > inactive.reach + blur(density):
            inactive_landmarks.append(inactive)
            continue
        q, noise, follows = inactive.q, inactive.covariance, np.zeros((3, before))
        if all(anchor in vas for anchor in inactive.anchors):
            index = [i for a in inactive.anchors for i in range(vas[a].start, vas[a].stop)]
            follows[:, index] = inactive.gain
            q = q + inactive.gain @ (density.mean[index] - inactive.anchors_q)
            noise = inactive.noise
        at = before + 3 * len(blocks)
        part = replace(inactive.landmark.components[0], weight=1.0, at=slice(at, at + 3))
        landmarks.append(replace(inactive.landmark, components=[part]))
        blocks.append((q, noise, follows))
    if not blocks:
        return density
    mean = np.concatenate([density.mean, *(q for q, _, _ in blocks)])
    linear = np.vstack([np.eye(before), *(follows for _, _, follows in blocks)])
    noise = block_diag(np.zeros((before, before)), *(noise for _, noise, _ in blocks))
    covariance = linear @ density.covariance @ linear.T + noise
    return replace(
        density,
        mean=mean,
        covariance=covariance,
        landmarks=landmarks,
        inactive_landmarks=inactive_landmarks,
    )
