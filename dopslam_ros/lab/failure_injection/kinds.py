"""The failures that can be injected, in a line each; what does it is imported when it is used."""

FAILURES = {
    "blackout": "no sets for 10 s, the controls go on",
    "dark": "neither sets nor controls for 10 s, in which the vehicle turns as it likes",
    "kidnap": "moved by 20 m and turned by any angle, of which the controls say nothing",
    "no_prior": "a start on a known map with no pose and no clock given",
    "no_map": "a start with nothing known but the base station",
    "none": "nothing happens: a vehicle that is noticed as lost is a false alarm",
}
