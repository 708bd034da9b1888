"""Reads and writes recordings and height profiles: files, data sets, units, resampling; generates textures."""

from vibrocast.textures.axes import AXES, REDUCTIONS
from vibrocast.textures.files import (
    SAVED_SUFFIXES,
    from_array,
    is_profile,
    load,
    load_for_actuators,
    load_profile,
    save,
    save_profile,
)
from vibrocast.textures.filtering import HIGHPASS_HZ, HighPassed, LiveHighPass, highpass, highpass_of, is_vibration
from vibrocast.textures.generate import GENERATORS, surface_profile, varying_speed
from vibrocast.textures.profiles import Profile
from vibrocast.textures.recording import FILE_UNITS, INPUT_UNITS, UNITS, Recording, TextureError
from vibrocast.textures.resampling import resample

__all__ = [
    "AXES",
    "FILE_UNITS",
    "GENERATORS",
    "HIGHPASS_HZ",
    "INPUT_UNITS",
    "REDUCTIONS",
    "SAVED_SUFFIXES",
    "UNITS",
    "HighPassed",
    "LiveHighPass",
    "Profile",
    "Recording",
    "TextureError",
    "from_array",
    "highpass",
    "highpass_of",
    "is_profile",
    "is_vibration",
    "load",
    "load_for_actuators",
    "load_profile",
    "resample",
    "save",
    "save_profile",
    "surface_profile",
    "varying_speed",
]
