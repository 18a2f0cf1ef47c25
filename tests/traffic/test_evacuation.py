"""The file of a simulated evacuation."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.traffic.networks import evacuation
from uavmec_jax.errors import PolicyError, TrafficError
from uavmec_jax.files.archives import read_checked, write_checked
from uavmec_jax.scenarios.policies import load_policy
from uavmec_jax.traffic.evacuation import HIGH_TRAFFIC, load_evacuation
from uavmec_jax.traffic.place import load_place

PAPER = {"round_lake": [2, 3, 4, 5, 7, 10], "albany": [1, 2, 3, 12]}
"""Devices in high traffic, by number (the paper's text on Table 7)."""


@pytest.mark.parametrize("name", PAPER)
def test_shipped_evacuations(name):
    loaded = load_evacuation(name)
    place, _ = load_place(name)
    assert loaded.name == name
    assert loaded.meta["names"] == [site.name for site in place.device]
    assert loaded.meta["settings"] == place.model_dump(mode="json")  # built with the present settings of the place
    assert (np.flatnonzero(loaded.busy) + 1).tolist() == PAPER[name]
    assert np.abs(loaded.weight - HIGH_TRAFFIC).min() > 0.05  # no device is near the threshold
    assert loaded.weight.max() == loaded.window_weight.max() == 1
    assert loaded.window_weight.shape == (12, 12)
    assert loaded.meta["warnings"] == []
    assert len(loaded.meta["teleports"]) == 10
    assert sum(loaded.meta["teleports"]) < 0.01 * sum(loaded.meta["loaded"])
    assert len(loaded.roads) == len(loaded.meta["roads"]) == loaded.road_density.shape[1]
    loaded.check_hops(speed_m_s=5.0, slot_cap_s=600.0)
    assert_allclose(loaded.weight, loaded.density / loaded.density.max(), rtol=1e-6)


def test_shipped_places_are_nearly_empty_at_the_end():
    for name in PAPER:
        density = load_evacuation(name).road_density.mean(axis=1)
        assert density[-1] < 0.25 * density.max()


def test_positions_are_metres_from_the_south_west_corner():
    place = evacuation(span=300.0)
    assert_allclose(place.local_position(), [[0, 0], [150, 75], [300, 150]])
    assert place.region_m() == (300, 150)
    assert_allclose(place.local_position(800.0)[-1], [800, 400])
    assert place.region_m(800.0) == (800, 400)


def test_hops_fit_into_a_slot():
    place = evacuation(span=3000.0)  # the longest hop: 3,354 m, 671 s at 5 m/s
    place.check_hops(5.0, 700.0)
    place.check_hops(5.0, 600.0, scale_to_m=800.0)
    with pytest.raises(TrafficError) as caught:
        place.check_hops(5.0, 600.0)
    assert str(caught.value) == (
        "hamlet: the hop from the start to site 3, 3,354 m, takes 671 s at 5 m/s; a slot lasts at most 600 s "
        "(slot_cap_s); place the devices closer or set place_scale_m"
    )


def test_round_trip(tmp_path):
    saved = evacuation()
    saved.save(tmp_path / "place.npz")
    again = load_evacuation(tmp_path / "place.npz")
    assert again.meta == saved.meta
    for field in dataclasses.fields(saved)[1:]:
        assert_array_equal(getattr(again, field.name), getattr(saved, field.name))
    assert [len(shape) for shape in again.roads] == [2, 3]
    assert_allclose(again.mean_road_density, [2, 40])
    assert [file.name for file in tmp_path.iterdir()] == ["place.npz"]


def test_files_that_are_no_evacuations(tmp_path):
    path = tmp_path / "place.npz"

    def refused(line, source=path):
        with pytest.raises(TrafficError, match=line):
            load_evacuation(source)

    refused("place.npz: cannot be read: No such file|place.npz: cannot be read: .*No such file")
    refused("albania: neither a file nor a shipped place; did you mean 'albany'?", "albania")
    evacuation().save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    refused("cannot be read")
    for place in range(200, len(whole), 997):
        flipped = bytearray(whole)
        flipped[place] ^= 0x10
        path.write_bytes(bytes(flipped))
        try:
            same = load_evacuation(path)
        except TrafficError:
            continue
        assert_array_equal(
            same.weight, evacuation().weight
        )  # a bit that nothing depends on, such as the time of a member
    path.write_bytes(b"<osm/>")
    refused("cannot be read")
    np.savez(path, weight=np.zeros(3))
    refused("is not an evacuation, or one from before")
    write_checked(path, 2, {"meta": {}}, {})
    refused("schema is 2; this version reads 1")
    write_checked(path, 1, {"meta": {}}, {"weight": np.zeros(3)})
    refused("is not an evacuation: it holds weight")


def test_an_altered_weight_is_noticed(tmp_path):
    path = tmp_path / "place.npz"
    evacuation().save(path)
    with np.load(path) as arrays:
        altered = {name: arrays[name] for name in arrays.files}
    altered["weight"] = altered["weight"] * 0.5
    np.savez(path, **altered)
    with pytest.raises(TrafficError, match="was altered: its contents do not fit their SHA-256"):
        load_evacuation(path)


def test_a_policy_is_no_evacuation(tmp_path):
    write_checked(tmp_path / "x.npz", 1, {"meta": {}}, {})
    with pytest.raises(
        PolicyError, match=r"x\.npz: is not a file of policies: its header has no agents, n_devices, set"
    ):
        load_policy(tmp_path / "x.npz")
    facts, arrays = read_checked(tmp_path / "x.npz", 1, "anything", TrafficError)
    assert facts["meta"] == {}
    assert arrays == {}
