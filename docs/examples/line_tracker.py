#!/usr/bin/env python3
"""A tracker that talks in lines of JSON and needs no package: it believes the latest detection of each object.

The detection's depth is corrected by the depth image: the object's surface cannot lie behind what is measured there.
"""

import array
import json
import sys

Matrix = list[float]
"""A 4x4 transform, row by row."""


def multiply(a: Matrix, b: Matrix) -> Matrix:
    """The product of two transforms."""
    return [sum(a[4 * row + k] * b[4 * k + column] for k in range(4)) for row in range(4) for column in range(4)]


def inverse(T: Matrix) -> Matrix:
    """Of a rigid transform."""
    R = [[T[4 * column + row] for column in range(3)] for row in range(3)]
    t = [-sum(R[row][k] * T[4 * k + 3] for k in range(3)) for row in range(3)]
    return [*R[0], t[0], *R[1], t[1], *R[2], t[2], 0.0, 0.0, 0.0, 1.0]


def moved_onto_surface(T: Matrix, frame: dict, radius: float) -> Matrix:
    """The pose, pushed away along its ray while the measured surface lies farther than the object could."""
    x, y, z = T[3], T[7], T[11]
    if z <= 0.0:
        return T
    u, v = round(frame["fx"] * x / z + frame["cx"]), round(frame["fy"] * y / z + frame["cy"])
    if not (0 <= u < frame["width"] and 0 <= v < frame["height"]):
        return T
    depth = array.array("f")
    with open(frame["depth"], "rb") as file:  # noqa: PTH123
        file.seek(4 * (v * frame["width"] + u))
        depth.frombytes(file.read(4))
    scale = min(max((depth[0] + radius) / z, 1.0), 1.1) if 0.0 < depth[0] - z < 0.1 else 1.0
    return [*T[:3], scale * x, *T[4:7], scale * y, *T[8:11], scale * z, *T[12:]]


def main() -> None:
    """Answer line by line."""
    smallest: dict[str, float] = {}
    cameras: dict[int, Matrix] = {}
    found: list[tuple[str, Matrix]] = []
    for line in sys.stdin:
        message = json.loads(line)
        if message["type"] == "models":
            smallest = {model["name"]: min(model["extents"]) for model in message["models"]}
            print(json.dumps({"type": "ready"}), flush=True)
            continue
        cameras[message["stamp"]] = message["T_map_camera"]
        for seen in message["hypotheses"]:
            if seen["stamp"] not in cameras:
                continue  # of an image that came while this program was late, and was never handed over
            T_map_object = multiply(cameras[seen["stamp"]], seen["T_camera_object"])
            near = [
                number
                for number, (name, T) in enumerate(found)
                if name == seen["class"] and sum((T[k] - T_map_object[k]) ** 2 for k in (3, 7, 11)) < 0.1**2
            ]
            if near:
                found[near[0]] = seen["class"], T_map_object
            else:
                found.append((seen["class"], T_map_object))
        T_camera_map = inverse(message["T_map_camera"])
        tracks = []
        for number, (name, T_map_object) in enumerate(found, start=1):
            T = moved_onto_surface(multiply(T_camera_map, T_map_object), message, smallest[name] / 2.0)
            tracks.append({"id": number, "class": name, "T_camera_object": T, "translation_sigma": 0.02})
        print(json.dumps({"stamp": message["stamp"], "tracks": tracks}), flush=True)


if __name__ == "__main__":
    main()
