"""Slots worked by hand, line by line of docs/model.md.

The layout ``three_devices``: device 0 at (30, 40), 50 m from the origin; device 1 at (30, 100), 60 m from device 0, so
sqrt(60^2 + 10^2) = 60.8276 m slant, within 65 m; device 2 at (330, 440). Standby 2, 3, 4 W, active 1, 1.5, 2.5 W, all
compute 10,000 bytes/s. Unless said otherwise the UAV flies from the origin to device 0 and every task is 3 MB:

  flight        50 m / 5 m/s = 10 s
  upload of 0   slant 10 m: gain 1e-5 / 10^4 = 1e-9, snr 0.1 * 1e-9 / 1e-13 = 1000,
                rate 2e7 * log2(1001) = 2e7 * 9.967226 = 199,344,520 bit/s, time 24e6 / rate = 0.120395 s
  upload of 1   slant^4 = 3700^2 = 13,690,000: gain 7.304602e-13, snr 0.7304602,
                rate 2e7 * log2(1.7304602) = 2e7 * 0.7911558 = 15,823,116 bit/s, time 1.516768 s
  compute of 2  3e6 / 10,000 = 300 s
  slot          max(300, 10 + 1.516768) = 300 s
  UAV           150 W * 10 s + 80 W * 290 s = 24,700 J
  battery 0     60,000 - (2 * 300 + 0.1 * 0.120395) = 59,399.98796 J
  battery 1     60,000 - (3 * 300 + 0.1 * 1.516768) = 59,099.84832 J
  battery 2     60,000 - (4 * 300 + 2.5 * 300)      = 58,050 J
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.small_scenarios import three_devices
from uavmec_jax.env import channel
from uavmec_jax.env.channel import upload_rate
from uavmec_jax.env.dynamics import Cause, State, initial_state, transition
from uavmec_jax.env.params import Params
from uavmec_jax.errors import ArgumentError

pytestmark = pytest.mark.usefixtures("with_and_without_jit")

VOLUMES = jnp.full(3, 3e6)
NO_POWER_NO_COMMS = three_devices()


def play(layout=NO_POWER_NO_COMMS, action=0, volumes=VOLUMES, params=None, **changes):
    params = Params(n_devices=3) if params is None else params
    state = initial_state(params, layout).replace(**changes)
    return jax.jit(transition)(params, layout, state, jnp.int32(action), volumes)


def test_first_state():
    state = initial_state(Params(n_devices=3), NO_POWER_NO_COMMS)
    assert_array_equal(state.battery, [60_000, 60_000, 60_000])
    assert_array_equal(state.age, [0, 0, 0])
    assert_array_equal(state.uav_position, [[0, 0]])
    assert (state.uav_energy, state.slot) == (1_600_000, 0)


def test_whole_slot():
    state, outcome = play()
    assert_allclose(state.battery, [59_399.98796, 59_099.84832, 58_050.0], rtol=1e-7)
    assert_array_equal(state.age, [0, 0, 1])
    assert_array_equal(state.uav_position, [[30, 40]])
    assert_allclose(state.uav_energy, 1_600_000 - 24_700, rtol=1e-7)
    assert state.slot == 1
    assert outcome.cause == Cause.NONE
    assert_allclose(outcome.duration, 300.0)
    assert_array_equal(outcome.served, [True, True, False])
    assert_array_equal(outcome.failed, [False] * 3)
    assert_array_equal(outcome.first_failure, [0, 0, 0])


def test_shannon_rate():
    rate = jax.jit(upload_rate)(Params(), jnp.array([10.0, np.sqrt(3700.0)]))
    assert_allclose(rate, [199_344_520.0, 15_823_116.0], rtol=1e-6)


def test_shannon_rate_of_a_weak_signal():
    # slant 3000 m: gain 1e-5 / 8.1e13, snr 1.234568e-7; log2(1 + snr) = snr / ln 2 = 1.781105e-7 (1 + 1.2e-7 is lost in f32)
    assert_allclose(jax.jit(upload_rate)(Params(), jnp.array([3000.0])), [2e7 * 1.781105e-7], rtol=1e-5)


def test_log1p_is_accurate_over_the_whole_range():
    x = np.float32(10 ** np.linspace(-12, 6, 2000))
    assert_allclose(jax.jit(channel._log1p)(jnp.asarray(x)), np.log1p(x.astype(float)), rtol=4e-7)


def test_staying_flies_nowhere():
    # From device 0 to device 0: no flight, the slot is still the 300 s of device 2, the UAV hovers: 80 * 300 = 24,000 J.
    state, outcome = play(uav_position=jnp.array([[30.0, 40.0]]))
    assert_allclose(outcome.duration, 300.0)
    assert_allclose(state.uav_energy, 1_600_000 - 24_000, rtol=1e-7)


def test_visited_device_is_served_even_beyond_the_range():
    # A range of 5 m is less than the altitude; the visited device is served nevertheless, its neighbour is not.
    _, outcome = play(params=Params(n_devices=3, uav_signal_range_m=5.0))
    assert_array_equal(outcome.served, [True, False, False])


def test_range_includes_the_altitude():
    # 60 m on the ground are 60.83 m slant: out of a range of 60.5 m, within one of 61 m.
    assert not play(params=Params(n_devices=3, uav_signal_range_m=60.5))[1].served[1]
    assert play(params=Params(n_devices=3, uav_signal_range_m=61.0))[1].served[1]


def test_long_work_is_dropped_at_the_cap():
    # 3 MB at 1,000 bytes/s would take 3,000 s; the cap is 600 s: T = 600, battery 2 pays (4 + 2.5) * 600 = 3,900 J.
    slow = three_devices(processing_rate=jnp.array([1e4, 1e4, 1e3]))
    state, outcome = play(slow)
    assert_allclose(outcome.duration, 600.0)
    assert_allclose(state.battery[2], 60_000 - 3_900, rtol=1e-7)


def test_flight_and_upload_can_be_the_longest():
    # Visiting device 2 from the origin: 550 m, 110 s, upload at 10 m slant 0.120395 s; the others compute 2e6 / 1e6 = 2 s.
    fast = three_devices(processing_rate=jnp.full(3, 1e6))
    state, outcome = play(fast, action=2, volumes=jnp.array([2e6, 2e6, 3e6]))
    assert_allclose(outcome.duration, 110.120395, rtol=1e-6)
    # 150 * 110 + 80 * 0.120395 = 16,509.63 J; device 0 pays 2 * 110.120395 + 1 * 2 = 222.24079 J.
    assert_allclose(state.uav_energy, 1_600_000 - 16_509.63, rtol=1e-7)
    assert_allclose(state.battery[0], 60_000 - 222.24079, rtol=1e-7)


def test_powered_devices_do_not_drain():
    state, _ = play(three_devices(has_power=(True, False, True)))
    assert_array_equal(state.battery[jnp.array([0, 2])], [60_000, 60_000])
    assert state.battery[1] < 60_000


def test_connected_devices_stay_fresh():
    state, _ = play(three_devices(has_comms=(False, False, True)), age=jnp.array([4, 5, 0]))
    assert_array_equal(state.age, [0, 0, 0])


def test_unconnected_unserved_device_ages():
    state, _ = play(action=2, age=jnp.array([4, 5, 6]))
    assert_array_equal(state.age, [5, 6, 0])


def test_data_may_be_ten_slots_old_but_not_eleven():
    assert play(age=jnp.array([0, 0, 9]))[1].cause == Cause.NONE
    state, outcome = play(age=jnp.array([0, 0, 10]))
    assert outcome.cause == Cause.DATA_AGE
    assert_array_equal(outcome.failed, [False, False, True])
    assert_array_equal(outcome.first_failure, [0, 0, 1])
    assert state.slot == 1  # the failing slot counts


def test_age_at_limit_fails():
    params = Params(n_devices=3, age_at_limit_fails=True)
    assert play(age=jnp.array([0, 0, 8]), params=params)[1].cause == Cause.NONE
    assert play(age=jnp.array([0, 0, 9]), params=params)[1].cause == Cause.DATA_AGE


def test_expired_data_share_the_failure():
    _, outcome = play(action=2, age=jnp.array([10, 10, 3]))
    assert_array_equal(outcome.failed, [True, True, False])
    assert_array_equal(outcome.first_failure, [0.5, 0.5, 0])


def test_battery_fails_when_empty_and_outranks_data():
    # Device 2 needs 1,950 J for the slot and has exactly that: empty is a failure.
    state, outcome = play(battery=jnp.array([6e4, 6e4, 1950.0]), age=jnp.array([0, 0, 10]))
    assert outcome.cause == Cause.BATTERY
    assert state.battery[2] == 0
    assert_array_equal(outcome.failed, [False, False, True])


def test_first_battery_inside_the_slot():
    # Device 0 (served) draws 600.01 J and has 300: lasts half the slot. Device 2 draws 1,950 J and has 1,000: 51 %.
    _, outcome = play(battery=jnp.array([300.0, 6e4, 1000.0]))
    assert_array_equal(outcome.failed, [True, False, True])
    assert_array_equal(outcome.first_failure, [1, 0, 0])
    # With 900 J device 2 is empty after 46 % of the slot, before device 0.
    assert_array_equal(play(battery=jnp.array([300.0, 6e4, 900.0]))[1].first_failure, [0, 0, 1])


def test_slot_beyond_the_uav_battery_never_starts():
    before = initial_state(Params(n_devices=3), NO_POWER_NO_COMMS).replace(uav_energy=jnp.array([24_699.0]))
    state, outcome = play(uav_energy=jnp.array([24_699.0]), age=jnp.array([0, 0, 10]))
    assert outcome.cause == Cause.UAV
    assert_array_equal(state.battery, before.battery)
    assert_array_equal(state.age, [0, 0, 10])
    assert_array_equal(state.uav_position, before.uav_position)
    assert state.uav_energy == 24_699.0
    assert state.slot == 0
    assert outcome.duration == 0
    assert not outcome.failed.any()
    assert not outcome.served.any()


def test_slot_that_empties_the_uav_battery_is_played():
    # Staying put costs exactly 24,000 J.
    state, outcome = play(uav_energy=jnp.array([24_000.0]), uav_position=jnp.array([[30.0, 40.0]]))
    assert outcome.cause == Cause.NONE
    assert (state.uav_energy, state.slot) == (0, 1)


def test_count_unfinished_slot():
    params = Params(n_devices=3, count_unfinished_slot=True)
    state, outcome = play(uav_energy=jnp.array([1.0]), params=params)
    assert outcome.cause == Cause.UAV
    assert state.slot == 1


def test_flight_power_adds_to_hover():
    # 150 W * 10 s + 80 W * 300 s = 25,500 J.
    state, _ = play(params=Params(n_devices=3, flight_power_adds_to_hover=True))
    assert_allclose(state.uav_energy, 1_600_000 - 25_500, rtol=1e-7)


def test_uplink_takes_time_and_energy_of_connected_devices():
    # 1 kB = 8,000 bit at 1,000 bit/s = 8 s for the connected, unserved device 2: T = 308 s,
    # it pays 4 * 308 + 2.5 * 300 + 0.1 * 8 = 1,982.8 J. The served device 0 sends nothing: 2 * 308 + 0.0120 = 616.012 J.
    layout = three_devices(has_comms=(True, True, True))
    state, outcome = play(layout, params=Params(n_devices=3, uplink_rate_bit_s=1000.0))
    assert_allclose(outcome.duration, 308.0, rtol=1e-6)
    assert_allclose(state.battery[jnp.array([0, 2])], [60_000 - 616.012, 60_000 - 1_982.8], rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "value"), [("noise_power_dbm", -90.0), ("path_loss_exponent", 5.0), ("reference_gain_db_at_1m", -60.0)]
)
def test_channel_constants_are_parameters(name, value):
    assert upload_rate(Params(**{name: value}), jnp.array([50.0])) < upload_rate(Params(), jnp.array([50.0]))


def test_state_is_not_changed_in_place():
    state = State(jnp.full(3, 6e4), jnp.zeros(3, jnp.int32), jnp.zeros((1, 2)), jnp.array([1e6]), jnp.int32(0))
    transition(Params(n_devices=3), NO_POWER_NO_COMMS, state, jnp.int32(0), VOLUMES)
    assert_array_equal(state.battery, [6e4] * 3)


STATE = initial_state(Params(n_devices=3), NO_POWER_NO_COMMS)
WRONG_SHAPES = {
    "volumes of four devices": {"volumes": jnp.full(4, 3e6)},
    "batch of volumes": {"volumes": jnp.full((2, 3), 3e6)},
    "batch of actions": {"action": jnp.array([0, 1])},
    "state of four devices": {"state": STATE.replace(battery=jnp.full(4, 6e4), age=jnp.zeros(4, jnp.int32))},
    "batch of layouts": {"layout": jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), NO_POWER_NO_COMMS)},
}


@pytest.mark.usefixtures("without_type_checks")
@pytest.mark.parametrize("changes", WRONG_SHAPES.values(), ids=WRONG_SHAPES)
def test_shapes_that_do_not_fit_together_are_refused(changes):
    arguments = {"layout": NO_POWER_NO_COMMS, "state": STATE, "action": jnp.int32(0), "volumes": VOLUMES, **changes}
    with pytest.raises(ArgumentError, match=r" has shape .*; it should be "):
        jax.jit(transition)(Params(n_devices=3), **arguments)
