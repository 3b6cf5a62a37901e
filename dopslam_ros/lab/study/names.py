"""What can be studied, in a line each; what does it is imported only when it is used."""

FILTERS = {
    "joint": "EK-PMB that keeps the correlation between vehicle and map",
    "marginal": "EK-PMB of the paper, which drops that correlation after every step",
    "pmbm": "EK-PMBM, which carries several global hypotheses on",
    "phd": "EK-PHD, whose map is an intensity without identities",
    "genie": "iterated EKF that is told the true association",
    "dead_reckoning": "the controls alone, no path used",
}
TROUBLES = {
    "blackout": "no sets for 10 s, the controls go on",
    "dark": "neither sets nor controls for 10 s, in which the vehicle turns as it likes",
    "kidnap": "moved by 20 m and turned by any angle, of which the controls say nothing",
    "no_prior": "a start on a known map with no pose and no clock given",
    "no_map": "a start with nothing known but the base station",
    "none": "nothing happens: a vehicle that is noticed as lost is a false alarm",
}
