"""The environment for other people's learners; importing this registers ``UavMec-v0`` with Gymnasium."""

from uavmec_jax.interop.registration import register

register()
