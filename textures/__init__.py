"""Recordings and height profiles in: files, data sets, units, resampling; and a texture generator."""

from vibrocast.textures.arrays import from_array
from vibrocast.textures.files import AXES, load, load_profile, save_profile, save_wav
from vibrocast.textures.filtering import HIGHPASS_HZ, HighPassed, LiveHighPass, highpass, is_vibration
from vibrocast.textures.generate import GENERATORS, surface_profile, varying_speed
from vibrocast.textures.profiles import Profile
from vibrocast.textures.recording import INPUT_UNITS, UNITS, Recording, TextureError
from vibrocast.textures.resampling import resample

__all__ = [
    "AXES",
    "GENERATORS",
    "HIGHPASS_HZ",
    "INPUT_UNITS",
    "UNITS",
    "HighPassed",
    "LiveHighPass",
    "Profile",
    "Recording",
    "TextureError",
    "from_array",
    "highpass",
    "is_vibration",
    "load",
    "load_profile",
    "resample",
    "save_profile",
    "save_wav",
    "surface_profile",
    "varying_speed",
]
