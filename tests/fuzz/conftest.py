"""Two lengths of the campaign: some tries of each kind in CI, always the same; `--hypothesis-profile=long` by hand."""

from hypothesis import HealthCheck, Phase, settings

ALWAYS = {
    "deadline": None,
    "database": None,
    "suppress_health_check": list(HealthCheck),
    # What fails is small as it is, and each try may take a second.
    "phases": [Phase.explicit, Phase.generate],
}
settings.register_profile("short", max_examples=12, derandomize=True, **ALWAYS)
settings.register_profile("long", max_examples=300, print_blob=True, **ALWAYS)
if settings.get_current_profile_name() != "long":
    settings.load_profile("short")
