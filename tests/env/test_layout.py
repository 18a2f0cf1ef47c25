"""Tables and random layouts."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from uavmec_jax.env import hardware
from uavmec_jax.env.layout import make_layout, sample_layout
from uavmec_jax.env.padding import pad_layout
from uavmec_jax.env.params import Params
from uavmec_jax.errors import ArgumentError


def test_tables_spot_checks():
    # Table 2: YOLOv3 on a Firefly 3.07 W; Table 3: DNN on a NanoPC-T4 973.1 bytes/s; Table 1: Jetson Nano standby 2.82 W.
    kind, task = hardware.DEVICE_TYPES.index, hardware.TASKS.index
    assert hardware.ACTIVE_POWER_W[task("YOLOv3"), kind("Firefly")] == np.float32(3.07)
    assert hardware.PROCESSING_RATE_BYTES_S[task("DNN"), kind("NanoPC-T4")] == np.float32(973.1)
    assert hardware.STANDBY_POWER_W[kind("Jetson Nano")] == np.float32(2.82)
    assert hardware.ACTIVE_POWER_W.shape == hardware.PROCESSING_RATE_BYTES_S.shape == (5, 5)


def test_make_layout_looks_up_the_hardware():
    resources = jnp.ones(2, bool)
    layout = make_layout(jnp.zeros((2, 2)), jnp.array([2, 4]), jnp.array([4, 2]), jnp.ones(2), resources, resources)
    assert_array_equal(layout.standby_power, np.float32([4.87, 1.88]))
    assert_array_equal(layout.active_power, np.float32([3.07, 2.595]))
    assert_array_equal(layout.processing_rate, np.float32([2733.97, 973.1]))


@pytest.mark.parametrize("n", [2, 12, 64])
def test_sampled_layout_has_the_counts_and_ranges(n):
    params = Params(n_devices=n, region_m=(800.0, 400.0))
    draw = jax.jit(jax.vmap(lambda key, p, c: sample_layout(key, params, p, c)))
    powered = jnp.arange(200) % (n + 1)
    layouts = draw(jax.random.split(jax.random.key(0), 200), powered, n - powered)
    assert_array_equal(layouts.has_power.sum(axis=1), powered)
    assert_array_equal(layouts.has_comms.sum(axis=1), n - powered)
    assert layouts.position.shape == (200, n, 2)
    assert (layouts.position >= 0).all()
    assert (layouts.position <= jnp.array([800.0, 400.0])).all()
    assert layouts.position[..., 1].max() > 350
    assert (layouts.capacity >= 50_000).all()
    assert (layouts.capacity <= 80_000).all()
    assert set(np.unique(layouts.device_type)) == set(range(5))
    assert set(np.unique(layouts.task)) == set(range(5))


@pytest.mark.slow
def test_masks_are_uniform_and_independent():
    layouts = jax.vmap(lambda key: sample_layout(key, Params(), 4, 8))(jax.random.split(jax.random.key(1), 20_000))
    power, comms = np.asarray(layouts.has_power), np.asarray(layouts.has_comms)
    # Each device is powered with probability 1/3: 20,000 draws, standard error 0.0033.
    assert np.abs(power.mean(axis=0) - 1 / 3).max() < 0.015
    assert np.abs(comms.mean(axis=0) - 2 / 3).max() < 0.015
    assert abs((power & comms).mean() - 2 / 9) < 0.01


def test_a_lower_count_changes_the_mask_alone():
    key = jax.random.key(3)
    some, fewer = sample_layout(key, Params(), 8, 6), sample_layout(key, Params(), 6, 6)
    chex.assert_trees_all_equal(some.replace(has_power=None), fewer.replace(has_power=None))
    assert (some.has_power | ~fewer.has_power).all()


@pytest.mark.usefixtures("without_type_checks")
def test_shapes_that_do_not_fit_together_are_refused():
    layout = sample_layout(jax.random.key(0), Params(), 4, 8)
    fields = layout.position, layout.device_type, layout.task, layout.capacity, layout.has_power, layout.has_comms
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), layout)
    with pytest.raises(ArgumentError, match=r"capacities of shape \(2, 12\); give one layout, not a batch"):
        pad_layout(batch, 16)
    with pytest.raises(AssertionError, match="rank"):
        sample_layout(jax.random.key(0), Params(), jnp.array([4, 5]), 8)
    with pytest.raises(AssertionError, match="shape"):
        make_layout(*fields[:-1], layout.has_comms[:11])
    with pytest.raises(AssertionError, match="shape"):
        make_layout(layout.position[:, :1], *fields[1:])
