"""Says `above` of two tracked objects where the one hangs over the other, from their positions and sizes alone."""

from itertools import permutations

from simtrack.contracts import Relation


class BoxesAbove:
    def __init__(self, models):
        self.sizes = {name: model.extents for name, model in models.items()}

    def update(self, stamp, tracks):
        known = [track for track in tracks if track.believed]
        found = set()
        for a, b in permutations(known, 2):
            dx, dy, dz = a.T_map_object[:3, 3] - b.T_map_object[:3, 3]
            reach = 0.5 * max(self.sizes[b.class_name][:2])
            if dz > 0.5 * self.sizes[b.class_name][2] and max(abs(dx), abs(dy)) < reach:
                found.add(Relation(f"{a.class_name}-{a.id}", "above", f"{b.class_name}-{b.id}"))
        return found
