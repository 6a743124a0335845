"""What holds for all tests."""

from hypothesis import HealthCheck, Phase, settings

# How long an example takes says more about what else the machine does than about the code, and how many of the first
# ones are too large or left out is a matter of luck; where no example is left, that is an error all the same.
settings.register_profile(
    "wayside",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much],
)
# For whoever wants to know only whether a test fails: the smallest example is not searched for.
settings.register_profile(
    "unshrunk",
    settings.get_profile("wayside"),
    phases=[Phase.explicit, Phase.generate],
    report_multiple_bugs=False,
)
settings.load_profile("wayside")
