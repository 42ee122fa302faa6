"""Drawings over camera images, as SVG: they stay crisp at any size and weigh little.

An image and what is drawn over it share the image's pixel coordinates: pixel centres lie at integer indices,
therefore the view box starts at -0.5.
"""

from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float64, Track, TrackStatus
from simtrack.evaluation.record import KeyFrame, graph_name
from simtrack.evaluation.tracking import ObjectFrame
from simtrack.geometry.meshes import Mesh
from simtrack.geometry.transforms import apply
from simtrack.report.colors import LEFT_OF, ON, REFERENCE

NEAR = 0.05
"""Metres: nothing nearer to the camera is drawn."""
_SUPERSAMPLING = 4
_EDGES = ((0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7))
_CORNERS = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])


def svg_image(
    data: bytes,
    mime: str,
    width: int,
    height: int,
    layers: Iterable[str] = (),
    title: str = "",
    window: tuple[float, float, float, float] | None = None,
) -> str:
    """An image with layers of SVG in its pixel coordinates; `window` (u, v, width, height) shows a part of it."""
    source = f"data:{mime};base64,{b64encode(data).decode()}"
    u, v, w, h = window or (-0.5, -0.5, width, height)
    return (
        f'<svg class="photo" viewBox="{u:g} {v:g} {w:g} {h:g}" role="img" aria-label="{escape(title)}">'
        f'<image href="{source}" x="-0.5" y="-0.5" width="{width}" height="{height}"/>{"".join(layers)}</svg>'
    )


def silhouette(mesh: Mesh, T_camera_object: Float64, intrinsics: CameraIntrinsics) -> list[Float64]:
    """Outer outlines of a mesh in the image, each (K, 2) pixels; empty if it cannot be seen.

    The triangles are filled at a multiple of the image's resolution and their common outline is traced.
    """
    import cv2

    points = apply(T_camera_object, mesh.vertices)
    faces = mesh.faces[(points[mesh.faces][:, :, 2] > NEAR).all(axis=1)]
    if not len(faces):
        return []
    depth = np.maximum(points[:, 2:], NEAR)
    pixels = points[:, :2] / depth * (intrinsics.fx, intrinsics.fy) + (intrinsics.cx, intrinsics.cy)
    used = pixels[np.unique(faces)]
    low = np.maximum(np.floor(used.min(axis=0)) - 2, (-8, -8))
    high = np.minimum(np.ceil(used.max(axis=0)) + 2, (intrinsics.width + 8, intrinsics.height + 8))
    size = ((high - low) * _SUPERSAMPLING).astype(int)
    if (size <= 0).any():
        return []
    canvas = np.zeros((size[1], size[0]), dtype=np.uint8)
    corners = np.clip((pixels - low) * _SUPERSAMPLING, -1e5, 1e5).round().astype(np.int32)
    for triangle in corners[faces]:
        cv2.fillConvexPoly(canvas, triangle, 255)
    contours, _ = cv2.findContours(canvas, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outlines = [cv2.approxPolyDP(c, 0.35 * _SUPERSAMPLING, True)[:, 0] / _SUPERSAMPLING + low for c in contours]
    return [outline for outline in outlines if len(outline) > 2]


def path_data(outlines: Iterable[Float64]) -> str:
    """Closed outlines as the ``d`` attribute of an SVG path."""
    return "".join("M" + "L".join(f"{u:.1f},{v:.1f}" for u, v in outline) + "Z" for outline in outlines)


def track_layer(
    frame: KeyFrame, meshes: Mapping[str, Mesh], colors: Mapping[str, str], labels: bool = True
) -> list[str]:
    """Outlines of all tracks: full where registered, dashed where kept without being seen, with their names."""
    layers, placed = [], []
    for track in sorted(frame.tracks, key=lambda t: -float(t.T_camera_object[2, 3])):
        mesh = meshes.get(track.class_name)
        if mesh is None or track.status is TrackStatus.TENTATIVE:
            continue
        outlines = silhouette(mesh, track.T_camera_object, frame.intrinsics)
        if not outlines:
            continue
        color = colors[track.class_name]
        kept = "" if track.status is TrackStatus.CONFIRMED else ' stroke-dasharray="5 4"'
        layers.append(
            f'<path d="{path_data(outlines)}" fill="{color}" fill-opacity=".16" stroke="{color}" stroke-width="1.8"'
            f' stroke-linejoin="round"{kept}/>'
        )
        if labels:
            layers.append(_label(graph_name(track), np.concatenate(outlines), color, frame.intrinsics, placed))
    return layers


def close_up(
    frame: KeyFrame, thing: ObjectFrame, mesh: Mesh, color: str, margin: float = 0.7
) -> tuple[list[str], tuple[float, float, float, float]]:
    """Outlines of one object, the estimated one and, white and dashed, the true one; and a window around them."""
    assert thing.track is not None
    estimated = silhouette(mesh, thing.track.T_camera_object, frame.intrinsics)
    true = silhouette(mesh, thing.T_camera_object, frame.intrinsics)
    points = np.concatenate([*estimated, *true]) if estimated or true else np.zeros((1, 2))
    low, high = points.min(axis=0), points.max(axis=0)
    height = max(
        float((high[1] - low[1]) * (1 + 2 * margin)), float((high[0] - low[0]) * (1 + 2 * margin)) * 0.75, 60.0
    )
    height = min(height, frame.intrinsics.height)
    size = np.array([height / 0.75, height])
    limit = np.array([frame.intrinsics.width, frame.intrinsics.height]) - 0.5
    corner = np.maximum(np.minimum((low + high) / 2 - size / 2, limit - size), -0.5)
    line = f'stroke-width="{height / 170:.2f}" fill="none" stroke-linejoin="round"'
    dash = f'stroke-dasharray="{height / 45:.2f} {height / 60:.2f}"'
    layers = [
        f'<path d="{path_data(estimated)}" stroke="{color}" {line}/>',
        f'<path d="{path_data(true)}" stroke="#fff" {line} {dash}/>',
    ]
    return layers, (float(corner[0]), float(corner[1]), float(size[0]), float(size[1]))


def _label(
    text: str, outline: Float64, color: str, intrinsics: CameraIntrinsics, placed: list[tuple[float, ...]]
) -> str:
    """A name tag above an outline, moved up until it covers no other."""
    width, height = 6.6 * len(text) + 8, 15.0
    u = float(np.clip(outline[:, 0].mean() - width / 2, 1, max(1.0, intrinsics.width - width - 1)))
    v = float(np.clip(outline[:, 1].min() - height - 4, 1, intrinsics.height - height - 1))
    for other in sorted(placed, key=lambda p: -p[1]):
        if u < other[0] + other[2] and other[0] < u + width and v < other[1] + height and other[1] < v + height:
            v = other[1] - height - 1
    v = max(v, 1.0)
    placed.append((u, v, width))
    return (
        f'<g class="tag"><rect x="{u:.1f}" y="{v:.1f}" width="{width:.1f}" height="{height}" rx="3" fill="{color}"/>'
        f'<text x="{u + width / 2:.1f}" y="{v + 11:.1f}">{escape(text)}</text></g>'
    )


def box_layer(
    T_camera_box: Float64,
    extents: Float64,
    intrinsics: CameraIntrinsics,
    color: str,
    fill: float = 0.0,
    width: float = 1.6,
) -> str:
    """A box with (3,) side lengths, centred at the origin of its frame: its edges and, faintly, its silhouette."""
    corners = apply(T_camera_box, _CORNERS * extents)
    lines = []
    for a, b in _EDGES:
        segment = _clip_near(corners[a], corners[b])
        if segment is not None:
            (u0, v0), (u1, v1) = (_pixel(p, intrinsics) for p in segment)
            lines.append(f"M{u0:.1f},{v0:.1f}L{u1:.1f},{v1:.1f}")
    body = ""
    if fill > 0.0 and (corners[:, 2] > NEAR).all():
        import cv2

        hull = cv2.convexHull(np.array([_pixel(p, intrinsics) for p in corners], dtype=np.float32))[:, 0].astype(float)
        body = f'<path d="{path_data([hull])}" fill="{color}" fill-opacity="{fill}"/>'
    return f'{body}<path d="{"".join(lines)}" fill="none" stroke="{color}" stroke-width="{width}"/>'


def query_layers(
    frame: KeyFrame, meshes: Mapping[str, Mesh], reach: float = 3.5
) -> tuple[list[str], list[tuple[str, str, Sequence[str]]]]:
    """The queries `on` and `left-of` drawn as in the tracking paper's Fig. 4.

    The reference's box is highlighted, its top (`on`) and left (`left-of`) projections, `reach` times its size, are
    drawn as boxes, and what stands in the relation is tinted red and cyan. Returns the layers and (relation,
    reference, subjects).
    """
    tracks = {graph_name(track): track for track in frame.tracks if track.class_name in meshes}
    layers: list[str] = []
    answers: list[tuple[str, str, Sequence[str]]] = []
    for relation, color, axis in (("left-of", LEFT_OF, 1), ("on", ON, 2)):
        reference, subjects = _richest(frame, relation, tracks)
        if reference is None:
            continue
        answers.append((relation, reference.class_name + f"-{reference.id}", subjects))
        mesh = meshes[reference.class_name]
        bounds = mesh.bounds
        extents, centre = mesh.extents, bounds.mean(axis=0)
        for name in subjects:
            outline = silhouette(meshes[tracks[name].class_name], tracks[name].T_camera_object, frame.intrinsics)
            layers.append(f'<path d="{path_data(outline)}" fill="{color}" fill-opacity=".5" stroke="{color}"/>')
        size, shift = extents.copy(), centre.copy()
        size[axis] *= reach
        shift[axis] += (extents[axis] + size[axis]) / 2
        region = reference.T_camera_object.copy()
        region[:3, 3] = apply(reference.T_camera_object, shift[None])[0]
        layers.append(box_layer(region, size, frame.intrinsics, color, fill=0.1))
        base = reference.T_camera_object.copy()
        base[:3, 3] = apply(reference.T_camera_object, centre[None])[0]
        layers.append(box_layer(base, extents, frame.intrinsics, REFERENCE, width=2.2))
    placed: list[tuple[float, ...]] = []
    named = {name for _, reference, subjects in answers for name in (reference, *subjects)}
    for name in sorted(named):
        outline = silhouette(meshes[tracks[name].class_name], tracks[name].T_camera_object, frame.intrinsics)
        if outline:
            layers.append(_label(name, np.concatenate(outline), "#1c2733", frame.intrinsics, placed))
    return layers, answers


def _richest(frame: KeyFrame, relation: str, tracks: Mapping[str, Track]) -> tuple[Track | None, list[str]]:
    """The reference in view with the most subjects in view, and those subjects."""
    seen = {name for name, track in tracks.items() if track.believed and track.visible_fraction > 0.3}
    answers: dict[str, list[str]] = {}
    for r in sorted(frame.relations, key=lambda r: (r.reference, r.subject)):
        if r.name == relation and r.subject in seen and r.reference in seen:
            answers.setdefault(r.reference, []).append(r.subject)
    if not answers:
        return None, []
    best = max(sorted(answers), key=lambda name: len(answers[name]))
    return tracks[best], answers[best]


def _clip_near(a: Float64, b: Float64) -> tuple[Float64, Float64] | None:
    """The part of a segment that lies before the near plane."""
    if a[2] < NEAR and b[2] < NEAR:
        return None
    if a[2] < NEAR:
        a = a + (NEAR - a[2]) / (b[2] - a[2]) * (b - a)
    elif b[2] < NEAR:
        b = b + (NEAR - b[2]) / (a[2] - b[2]) * (a - b)
    return a, b


def _pixel(point: Float64, k: CameraIntrinsics) -> tuple[float, float]:
    return k.fx * point[0] / point[2] + k.cx, k.fy * point[1] / point[2] + k.cy
