"""Tracks of objects with known models: registration, filtering, data association and life cycle.

Per frame (tracking paper, III.B): all tracked instances stand in one scene; rays are traced, each instance is
registered to the depth image and its filter takes the result. Rays say what became of an object that is not confirmed:
something in front of it (occluded: kept) or nothing where its surface should be (gone: pruned). Detections arrive
late; they are matched, born and fused at the stamp of their image and replayed through the depth images since.
"""

from collections import deque
from collections.abc import Mapping, Sequence

import numpy as np

from simtrack.contracts import (
    NANOSECONDS,
    Float64,
    PoseHypothesis,
    RgbdFrame,
    Status,
    Track,
    TrackerResult,
    TrackStatus,
)
from simtrack.errors import UnknownNameError
from simtrack.geometry.transforms import inverse, rotate_covariance
from simtrack.objects import ObjectModel
from simtrack.perception.tracking.association import (
    assign,
    association_cost,
    box_overlap,
    group_by_detection,
    nearest_equivalent,
    rotation_apart,
)
from simtrack.perception.tracking.birth import NoiseLevel, Occluders, Prober, believable, cost, fits_noise
from simtrack.perception.tracking.claims import Claim, ClaimQueue, Views
from simtrack.perception.tracking.correspondences import usable_depth
from simtrack.perception.tracking.filter import Measurement, PoseFilter
from simtrack.perception.tracking.follow_up import Candidate, measurement
from simtrack.perception.tracking.identity import all_seen, one_vanishes, reappeared, replaced
from simtrack.perception.tracking.registration import Registration, RegistrationResult
from simtrack.perception.tracking.target import (
    Target,
    TrackerConfig,
    View,
    beside,
    camera_error_at,
    share_in_image,
    tracked_model,
)
from simtrack.perception.tracking.trace import RegistrationTrace

SAME_PLACE = 0.2
"""Boxes of objects have at most this share in common, unless one of the objects is not there."""


class ObjectTracker:
    """Tracker of the objects whose models it is given; implements `simtrack.contracts.Tracker`.

    ::

        tracker = ObjectTracker({"relay": load_object("relay")})
        result = tracker.update(frame, T_map_camera, covariance, hypotheses)
    """

    def __init__(self, models: Mapping[str, ObjectModel], config: TrackerConfig | None = None) -> None:
        self.config = config or TrackerConfig()
        self._models = dict(models)
        self._tracked = {name: tracked_model(model) for name, model in self._models.items()}
        self._registration = Registration(self.config.registration)
        self._prober = Prober(self.config.registration, self.config.fit)
        self._claimant = Prober(self.config.registration, self.config.fit)
        self._claims = ClaimQueue(self._claimant, self._tracked, self.config)
        self._targets: list[Target] = []
        self._next_id = 1
        self._views: deque[View] = deque()
        self._noise = NoiseLevel()
        self.trace: RegistrationTrace | None = None
        """The last frame's registration, for those who look for the cause of an error."""

    def close(self) -> None:
        """Release the scenes' memory."""
        self._claims.close()
        self._registration.close()
        self._prober.close()
        self._claimant.close()

    # ------------------------------------------------------------------------------------------------------- the frame

    def update(
        self,
        frame: RgbdFrame,
        T_map_camera: Float64,
        covariance: Float64,
        hypotheses: Sequence[PoseHypothesis] = (),
    ) -> TrackerResult:
        """Fuse one depth image and what detectors said of this or earlier images.

        Args:
            frame: depth (H, W), metres, 0 = no reading; its colour is not used.
            T_map_camera: (4, 4), the robot's belief.
            covariance: (6, 6) of it, map frame.
            hypotheses: pose hypotheses of images whose stamps lie within the buffer.

        Raises:
            UnknownNameError: a hypothesis of a class without a model.

        """
        for h in hypotheses:
            if h.class_name not in self._models:
                raise UnknownNameError("object class", h.class_name, self._models)
        if self._views and frame.stamp <= self._views[-1].stamp:
            return TrackerResult(frame.stamp, self._tracks(self._views[-1]), Status.STALE)
        depth = usable_depth(frame.depth)
        view = View(
            frame.stamp, depth, frame.intrinsics, T_map_camera, covariance, frame.T_base_camera, self._noise.value
        )
        self._views.append(view)
        while view.stamp - self._views[0].stamp > self.config.buffer * NANOSECONDS:
            self._views.popleft()
        status = Status.OK if np.any(view.depth) else Status.NO_DATA
        self._register(view, status, hypotheses)
        self._take_detections(hypotheses)
        self._settle_claims(view.stamp)
        self._prune(view.stamp)
        self._reunite(view.stamp)
        return TrackerResult(frame.stamp, self._tracks(view), status)

    def _register(self, view: View, status: Status, hypotheses: Sequence[PoseHypothesis]) -> None:
        """Register all living targets to a view and judge each."""
        T_camera_map = inverse(view.T_map_camera)
        living = [t for t in self._targets if t.alive]
        poses = {t.id: T_camera_map @ t.filter.predict(view.stamp).T_map_object for t in living}
        results = {}
        if status is not Status.NO_DATA:
            results = self._registration.track(view.depth, view.intrinsics, poses)
        self.trace = RegistrationTrace(
            view.stamp, view.depth, view.intrinsics, view.T_map_camera, {t.id: t.model.name for t in living}, poses,
            results, tuple(hypotheses),
        )  # fmt: skip
        for target in living:
            self._judge(target, view, poses[target.id], results.get(target.id))
        self._noise.learn([t.result.misfit for t in living if t.result is not None and t.clear(self.config)])

    def _judge(self, target: Target, view: View, T_predicted: Float64, result: RegistrationResult | None) -> None:
        """What one registration says of a target: seen, occluded, out of view or missing."""
        config = self.config
        target.result = result
        inside = share_in_image(target.model, T_predicted, view.intrinsics)
        if result is None or result.rays < config.min_rays:
            target.filter.skip(view.stamp)
            target.visible_fraction, target.missing_since = 0.0, None
            if target.status is not TrackStatus.TENTATIVE:
                hidden = inside > 0.5 and T_predicted[2, 3] > 0.0
                target.status = TrackStatus.OCCLUDED if hidden else TrackStatus.OUT_OF_VIEW
            return
        target.visible_fraction = result.supported / max(result.rays, 1) * inside
        jump = float(np.linalg.norm(result.T_camera_object[:3, 3] - T_predicted[:3, 3]))
        supported = result.supported >= config.min_rays and result.support >= config.keep_support
        if supported and jump <= config.max_jump and result.constrained >= 1:
            self._measure(target, view, result, jump)
            return
        target.filter.skip(view.stamp)
        valid = result.supported + result.occluded + result.missing
        if result.missing > 0.35 * max(valid, 1) and result.missing > 2 * result.supported:
            if target.missing_since is None:
                target.missing_since = view.stamp
            if view.stamp - target.missing_since >= config.lost_after * NANOSECONDS:
                self._lose(target)
            return
        if valid < 0.2 * result.rays:
            return  # hardly any reading: nothing was learned
        target.missing_since = None
        if target.status is not TrackStatus.TENTATIVE:
            target.status = TrackStatus.OCCLUDED if inside > 0.3 else TrackStatus.OUT_OF_VIEW

    def _measure(self, target: Target, view: View, result: RegistrationResult, jump: float) -> None:
        """Fuse an accepted registration."""
        gap = view.stamp - target.last_seen > self.config.unseen_gap * NANOSECONDS
        settled = target.status is not TrackStatus.TENTATIVE
        if settled and gap and target.known and jump > self.config.displaced and target.vague(self.config):
            # It was moved while nobody looked, and its surface alone does not tell how: detections have to.
            self._demote(target, view.stamp)
        taken = measurement(view, result, target.last_seen, self.config)
        # What is held far away, and is vague, fits the fingers before it nearly as well.
        poor = result.misfit > self.config.poor_misfit or (
            target.vague(self.config) and not fits_noise(result, self.config.fit, view.noise)
        )
        if target.known and (poor or self._incredible(target, taken)):
            target.filter.skip(view.stamp)
            target.doubts += 1
            if target.doubts >= self.config.doubt_after and target.status is not TrackStatus.TENTATIVE:
                self._demote(target, view.stamp)
            return
        target.doubts = 0
        target.filter.update(taken)
        target.frames += 1
        if target.status is TrackStatus.CONFIRMED:
            target.believed += view.stamp - target.last_seen
        target.last_seen = view.stamp
        target.missing_since = None
        target.residual = result.residual
        target.moved_when_seen = target.filter.state.moving
        target.score = min(0.99, target.score + 0.05)
        if target.status is not TrackStatus.TENTATIVE or self._proven(target, result):
            target.status, target.known = TrackStatus.CONFIRMED, True

    def _proven(self, target: Target, result: RegistrationResult) -> bool:
        """Whether enough has been seen of a new object to believe in it."""
        if not fits_noise(result, self.config.fit, self._noise.value) or target.frames < self.config.confirm_frames:
            return False
        if one_vanishes(self._targets, target):
            return False
        # A fit that leaves no doubt needs no second detection.
        clear = not target.doubtful(self.config) and not target.vague(self.config)
        return target.detections >= (1 if clear else self.config.confirm_detections)

    def _incredible(self, target: Target, m: Measurement) -> bool:
        """Whether a registration tells of a motion that is too fast for hands, or that it cannot tell of.

        A hand that takes a small thing far away is one blob with it: its registration follows the hand. So an object
        that stood still is only believed to move if the depth image determines its orientation, and what moves only
        while it does at all.
        """
        span = 0.1
        T_before = target.filter.pose_at(m.stamp - round(span * NANOSECONDS))
        moved = float(np.linalg.norm(m.T_map_object[:3, 3] - T_before[:3, 3]))
        turned = rotation_apart(m.T_map_object, T_before, target.model)
        if moved > self.config.fastest * span or turned > self.config.fastest_turn * span:
            return True
        if target.filter.state.moving and target.vaguer(self.config.fit.rotation_sigma):
            return True
        return target.vague(self.config) and target.filter.starts_to_move(m)

    @staticmethod
    def _demote(target: Target, stamp: int) -> None:
        """End the belief in a track until detections bear it out."""
        target.status, target.born, target.newcomer = TrackStatus.TENTATIVE, stamp, False
        target.detections, target.frames, target.disagreements, target.doubts = 0, 0, 0, 0

    def _lose(self, target: Target) -> None:
        """Take a target out of the scene; its identity is kept for when the object turns up again."""
        if target.believed < self.config.identity_time * NANOSECONDS:
            self._targets.remove(target)
        target.status = TrackStatus.LOST
        target.visible_fraction = 0.0
        self._registration.remove(target.id)

    def _prune(self, now: int) -> None:
        """Drop new objects that were not confirmed in time."""
        for target in list(self._targets):
            stale = now - target.born > self.config.tentative_timeout * NANOSECONDS
            if target.status is TrackStatus.TENTATIVE and stale:
                self._lose(target)

    def _reunite(self, now: int) -> None:
        """What turned up a moment before a known object of its class was seen to be gone is that object."""
        for new in list(self._targets):
            before = replaced(self._targets, new, now, self.config)
            if before is None:
                continue
            if before.alive:
                self._registration.remove(before.id)
            self._targets.remove(before)
            self._registration.remove(new.id)
            before.status = TrackStatus.LOST
            new.id, new.known, new.newcomer, new.believed = before.id, True, False, new.believed + before.believed
            self._registration.add(new.id, self._tracked[new.model.name])

    # -------------------------------------------------------------------------------------------------- late detections

    def _take_detections(self, hypotheses: Sequence[PoseHypothesis]) -> None:
        """Match detections to targets at the stamp of their image; what matches none may be a new object."""
        for stamp in sorted({h.stamp for h in hypotheses}):
            view = next((v for v in self._views if v.stamp == stamp), None)
            if view is None:
                continue
            T_camera_map = inverse(view.T_map_camera)
            groups = group_by_detection([h for h in hypotheses if h.stamp == stamp])
            living = [t for t in self._targets if t.alive]
            poses = [T_camera_map @ t.filter.pose_at(stamp) for t in living]
            costs = np.full((len(groups), len(living)), np.inf)
            for i, group in enumerate(groups):
                for j, target in enumerate(living):
                    if target.model.name == group[0].class_name:
                        costs[i, j] = association_cost(group[0], poses[j], target.model.diameter, view.intrinsics)
            pairs = dict(assign(costs))
            for i, group in enumerate(groups):
                if i in pairs:
                    self._confirm(living[pairs[i]], poses[pairs[i]], group, view)
                else:
                    self._claims.add(Claim(group, view, None))

    def _settle_claims(self, now: int) -> None:
        """Take the answers to the claims whose time is up, and begin with the next ones."""

        def later(claim: Claim, stamp: int) -> Views:
            return self._since(stamp + 1, claim.target)

        while (settled := self._claims.settle(now, later)) is not None:
            claim, candidate = settled
            if candidate is not None and claim.target is None:
                self._bear(claim, candidate)
            elif candidate is not None:
                self._contest(claim, candidate)
            if not self.config.wait:
                break  # one a frame: where nobody waits, the others can
        self._claims.work(now, self._views[0].stamp, later)

    def _confirm(self, target: Target, T_camera_object: Float64, group: list[PoseHypothesis], view: View) -> None:
        """Take a detection of a tracked object: fuse it, or let it contest an orientation that it disagrees with."""
        apart = [rotation_apart(h.T_camera_object, T_camera_object, target.model) for h in group]
        nearest = group[int(np.argmin(apart))]
        limit = self.config.doubt if target.doubtful(self.config) else self.config.disagreement
        aside = beside(nearest.T_camera_object, T_camera_object) > self.config.beside * target.model.diameter
        # Demoted, and its registrations are not believed either: the detection is to say where it is.
        adrift = target.status is TrackStatus.TENTATIVE and target.known and target.doubts > 0
        if min(apart) <= limit and not aside and not adrift:
            target.disagreements = 0
            target.detections += 1
            target.score = min(0.99, target.score + 0.1)
            self._fuse_late(target, T_camera_object, nearest, view)
            return
        target.disagreements += 1
        unsettled = (
            target.status is TrackStatus.TENTATIVE or view.stamp > target.last_seen or target.doubtful(self.config)
        )
        if unsettled or target.disagreements >= 2:
            self._claims.add(Claim(group, view, target))
        if target.disagreements >= self.config.demote_after and target.vague(self.config):
            # Detections say again and again that it is otherwise, and the depth image cannot tell: no knowledge.
            self._demote(target, self._views[-1].stamp)

    def _fuse_late(self, target: Target, T_camera_object: Float64, h: PoseHypothesis, view: View) -> None:
        """Fuse a detection's pose at its own stamp, unless it lies outside of its own error bounds."""
        T = nearest_equivalent(h.T_camera_object, T_camera_object, target.model)
        R = view.T_map_camera[:3, :3]
        error = T[:3, 3] - T_camera_object[:3, 3]
        if float(error @ np.linalg.solve(h.covariance[:3, :3], error)) < 12.0:
            target.filter.update(
                Measurement(view.stamp, view.T_map_camera @ T, rotate_covariance(R, h.covariance), np.zeros((6, 6)))
            )

    def _contest(self, claim: Claim, challenger: Candidate) -> None:
        """Let a detection's pose and the track's compete for the better fit to the depth image of its stamp."""
        target, view = claim.target, claim.view
        if target is None or not target.alive:
            return
        T_camera_object = inverse(view.T_map_camera) @ target.filter.pose_at(view.stamp)
        model, around = self._tracked[target.model.name], self._around(view, but=target)
        holder = self._prober.judge(T_camera_object, model, view.depth, view.intrinsics, around)
        if holder is not None and self._both_there(holder, challenger.fit, target, view):
            target.disagreements = 0  # two of a kind, side by side
            self._bear(Claim(claim.group, view, None), challenger)
            return
        # The more often detections have contradicted a pose, the better it has to fit to stay.
        margin = 1.3 / max(1.0, 0.5 * target.disagreements)
        if holder is not None and cost(holder) < margin * cost(challenger.fit):
            return
        self._catch_up(challenger, but=target)
        if not challenger.lost:
            state = challenger.filter
            target.filter, target.last_seen, target.disagreements = state, state.state.stamp, 0
            target.doubts, target.detections = 0, target.detections + 1

    def _both_there(self, a: RegistrationResult, b: RegistrationResult, target: Target, view: View) -> bool:
        """Whether two poses of a target's model are believable each, and explain different measurements."""
        model = self._tracked[target.model.name]
        extents, poses = target.model.extents, (a.T_camera_object, b.T_camera_object)
        if (
            not believable(a, self.config.fit, view.noise)
            or box_overlap(poses[0], extents, poses[1], extents) >= SAME_PLACE
        ):
            return False
        shared = self._prober.shared(poses[1], model, poses[0], model, view.depth, view.intrinsics)
        return shared < self.config.shared_surface

    def _bear(self, claim: Claim, candidate: Candidate) -> None:
        """Make a detection that no track explains a track: a registered hypothesis of it is believable."""
        group, view, model, result = claim.group, claim.view, self._models[claim.class_name], candidate.fit
        T_map_object = view.T_map_camera @ result.T_camera_object
        for other in list(self._targets):
            T_other = other.filter.pose_at(view.stamp)
            if not other.alive or box_overlap(T_map_object, model.extents, T_other, other.model.extents) < SAME_PLACE:
                continue
            T_camera_other = inverse(view.T_map_camera) @ T_other
            if other.model is model:
                self._confirm(other, T_camera_other, group, view)
                return
            rival = self._tracked[other.model.name]
            tracked = self._tracked[model.name]
            shared = self._prober.shared(
                result.T_camera_object, tracked, T_camera_other, rival, view.depth, view.intrinsics
            )
            if shared < self.config.shared_surface:
                continue
            if not self._outdoes(result, other, T_camera_other, view):
                return
            self._lose(other)
        self._catch_up(candidate)
        if candidate.lost:
            return
        followed = candidate.filter
        target = self._known_before(model, followed) or self._newcomer(model, followed, view)
        target.filter, target.last_seen = followed, followed.state.stamp
        target.residual, target.missing_since = result.residual, None
        target.frames = candidate.frames if all_seen(self._targets, target, followed.state.stamp) else 0
        self._registration.add(target.id, self._tracked[model.name])

    def _around(self, view: View, but: Target | None = None) -> Occluders:
        """The believed objects at a view's stamp: what may stand in front of a candidate."""
        T_camera_map = inverse(view.T_map_camera)
        return {
            t.id: (self._tracked[t.model.name], T_camera_map @ t.filter.pose_at(view.stamp))
            for t in self._targets
            if t.status is TrackStatus.CONFIRMED and t is not but
        }

    def _outdoes(self, result: RegistrationResult, other: Target, T_camera_other: Float64, view: View) -> bool:
        """Whether a candidate of another class explains a place clearly better than the track that holds it."""
        around = self._around(view, but=other)
        holder = self._prober.judge(
            T_camera_other, self._tracked[other.model.name], view.depth, view.intrinsics, around
        )
        if holder is None:
            return False
        established = 3.0 if other.status is not TrackStatus.TENTATIVE else 1.5
        return cost(result) * established < cost(holder)

    def _newcomer(self, model: ObjectModel, followed: PoseFilter, view: View) -> Target:
        target = Target(self._next_id, model, followed, born=view.stamp)
        self._next_id += 1
        self._targets.append(target)
        return target

    def _known_before(self, model: ObjectModel, followed: PoseFilter) -> Target | None:
        """The target that a reappearing object is: it keeps its identity and is believed after another detection."""
        target = reappeared(self._targets, model, followed, self.config)
        if target is None:
            return None
        if target.alive:
            self._registration.remove(target.id)
        target.status, target.born, target.newcomer = TrackStatus.TENTATIVE, followed.state.stamp, False
        target.detections, target.frames = 1, 0
        return target

    def _catch_up(self, candidate: Candidate, but: Target | None = None) -> None:
        """Lead a candidate through the depth images that came since it was worked at."""
        candidate.follow(self._prober, self._since(candidate.reached + 1, but), self.config)

    def _since(self, stamp: int, but: Target | None) -> Views:
        """The kept depth images from a stamp on, with the objects that are believed to stand there, but one."""
        return [(view, self._around(view, but)) for view in self._views if view.stamp >= stamp]

    # ---------------------------------------------------------------------------------------------------------- results

    def _tracks(self, view: View) -> tuple[Track, ...]:
        T_camera_map = inverse(view.T_map_camera)
        tracks = []
        for t in self._targets:
            state = t.filter.predict(view.stamp)
            seen = t.last_seen == view.stamp
            covariance = state.covariance[:6, :6] + camera_error_at(view, state.T_map_object)
            tracks.append(
                Track(
                    id=t.id,
                    class_name=t.model.name,
                    status=t.status,
                    stamp=view.stamp,
                    T_map_object=state.T_map_object,
                    covariance=covariance,
                    T_camera_object=T_camera_map @ state.T_map_object,
                    velocity=state.velocity,
                    last_seen=t.last_seen,
                    visible_fraction=t.visible_fraction,
                    moving=state.moving and seen,
                    residual=t.residual,
                    score=t.score if t.alive else 0.0,
                )
            )
        return tuple(tracks)
