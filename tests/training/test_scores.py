"""Average precision: what it must be where it is known."""

import numpy as np

from simtrack.perception.detection.boxes import Box
from simtrack.training.scores import average_precision

A, B = np.array([0.0, 0.0, 10.0, 10.0]), np.array([50.0, 50.0, 70.0, 70.0])


def there(*visible: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.stack([A, B][: len(visible)]), np.zeros(len(visible), int), np.array(visible)


def test_all_found_is_one_and_nothing_found_is_zero() -> None:
    assert average_precision([[Box(0, A, 0.9), Box(0, B, 0.8)]], [there(1.0, 1.0)], 1)[0] == 1.0
    assert average_precision([[]], [there(1.0, 1.0)], 1)[0] == 0.0
    assert np.isnan(average_precision([[Box(1, A, 0.9)]], [there(1.0)], 2)[1])


def test_mistakes_cost_where_they_are_surer_than_what_is_right() -> None:
    nowhere = np.array([200.0, 200.0, 210.0, 210.0])
    late = average_precision([[Box(0, A, 0.9), Box(0, nowhere, 0.5)]], [there(1.0)], 1)[0]
    early = average_precision([[Box(0, A, 0.5), Box(0, nowhere, 0.9)]], [there(1.0)], 1)[0]
    twice = average_precision([[Box(0, A, 0.5), Box(0, A, 0.9)]], [there(1.0)], 1)[0]
    assert (late, early, twice) == (1.0, 0.5, 1.0)


def test_hidden_objects_are_neither_missed_nor_wrong() -> None:
    assert average_precision([[Box(0, A, 0.9)]], [there(1.0, 0.2)], 1)[0] == 1.0
    assert average_precision([[Box(0, A, 0.8), Box(0, B, 0.9)]], [there(1.0, 0.2)], 1)[0] == 1.0


def test_half_of_the_objects_give_half_of_the_area() -> None:
    value = average_precision([[Box(0, A, 0.9)]], [there(1.0, 1.0)], 1)[0]
    assert np.isclose(value, 51 / 101)  # recalls 0, 0.01, ... 0.5 of COCO's 101
