# SPDX-License-Identifier: Apache-2.0
"""Task parameters as they are typed: one performance, rows and grids, and what is refused."""

import numpy as np
import pytest

from jaxskills import task_values
from jaxskills.env import conditions, measure
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.errors import UserError

SPEC = TaskSpec(
    (
        Parameter("energy", (0.8, 1.8), measure=measure.at(0.4, measure.kinetic_energy)),
        Parameter("feet", (1.0, 1.0), measure=measure.at(0.9, measure.com_height)),
        Parameter("gravity", (0.5, 1.5), condition=conditions.gravity),
        Parameter("mass", (1.0, 3.0), condition=conditions.gravity),
    )
)
OWN = np.array([0.2, 0.5, -0.25])  # the reference's mass lies outside the range


def _parse(*words: str) -> task_values.Wanted:
    return task_values.parse(SPEC, OWN, words)


def test_nothing_is_the_reference():
    found = _parse()
    np.testing.assert_allclose(found.a, [[OWN]], atol=1e-6)
    assert found.names == (("reference",),)


def test_one_value_each():
    found = _parse("gravity=0.75", "energy=1.8")
    np.testing.assert_allclose(found.a, [[[1.0, 0.25, -0.25]]], atol=1e-6)
    assert found.names == (("gravity 0.75, energy 1.8",),)


def test_several_values_go_across():
    found = _parse("mass=2", "energy=0.8,1.3,1.8")
    np.testing.assert_allclose(found.a[0, :, 0], [0.0, 0.5, 1.0], atol=1e-6)
    np.testing.assert_allclose(found.a[0, :, 1:], [[0.5, 0.5]] * 3, atol=1e-6)
    assert found.names[0][2] == "mass 2, energy 1.8"


def test_the_second_one_goes_down():
    found = _parse("gravity=0.5,1.5", "energy=0.8,1.3,1.8")
    assert found.a.shape == (3, 2, 3)
    np.testing.assert_allclose(found.a[:, :, 1], [[0.0, 1.0]] * 3, atol=1e-6)
    np.testing.assert_allclose(found.a[:, :, 0], [[0.0, 0.0], [0.5, 0.5], [1.0, 1.0]], atol=1e-6)
    assert found.names[2] == ("gravity 0.5, energy 1.8", "gravity 1.5, energy 1.8")


def test_a_spread_is_over_all_of_the_first_two():
    found = task_values.spread(SPEC, OWN)
    assert found.a.shape == (3, 3, 3)
    np.testing.assert_allclose(found.a[..., 2], OWN[2])
    assert (found.a[..., :2].min(), found.a[..., :2].max()) == (0.0, 1.0)
    row = task_values.spread(TaskSpec(SPEC.parameters[:2]), OWN[:1], 5)
    np.testing.assert_allclose(row.a[0, :, 0], np.linspace(0, 1, 5), atol=1e-6)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("speed=1",), "unknown task parameter 'speed': choose one of energy, gravity, mass"),
        (("feet=1",), "unknown task parameter 'feet'"),
        (("energy",), "task parameter energy is '': give it a number, as in energy=1.2"),
        (("energy=much",), "task parameter energy is 'much': give it a number"),
        (("energy=1,",), "task parameter energy is '1,': give it a number"),
        (("energy=2",), "task parameter energy is 2.0: give 0.8 to 1.8"),
        (("energy=nan",), "task parameter energy is nan: give 0.8 to 1.8"),
        (("energy=1", "energy=1.2"), "task parameter energy comes twice"),
        (("energy=1,1.2", "gravity=1,1.2", "mass=1,2"), "energy, gravity, mass have several"),
        (("energy=" + ",".join(["1"] * 26),), "a grid of more than 25 performances"),
    ],
)
def test_what_means_nothing_is_refused(words: tuple[str, ...], says: str):
    with pytest.raises(UserError) as raised:
        _parse(*words)
    assert says in str(raised.value) and "\n" not in str(raised.value)
