"""Settings of every test: hypothesis tries the same examples everywhere and does not judge the machine's speed."""

from hypothesis import HealthCheck, settings

settings.register_profile("all", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("all")
