"""``simtrack scenes``: what can be simulated."""


def scenes() -> int:
    """List the scenes that can be simulated. More are found in the folders that $SIMTRACK_SCENES names."""
    from simtrack.cli import console
    from simtrack.errors import SimtrackError
    from simtrack.simulation.scene_file import load_scene, scene_names

    rows: list[tuple[str, str, str]] = []
    broken: list[str] = []
    for name in sorted(scene_names()):
        try:
            scene = load_scene(name)
        except SimtrackError as error:
            broken.append(str(error))
            continue
        rows.append((name, f"{scene.duration:g} s", scene.description))
    console.show_table(("scene", "duration", "description"), rows, right=(1,))
    for message in broken:
        console.show_error(message)
    return 2 if broken else 0
