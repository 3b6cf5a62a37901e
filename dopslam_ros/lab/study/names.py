"""The filters that can be studied, in a line each; what does it is imported when it is used."""

FILTERS = {
    "joint": "EK-PMB that keeps the correlation between vehicle and map",
    "marginal": "EK-PMB of the paper, which drops that correlation after every step",
    "pmbm": "EK-PMBM, which carries several global hypotheses on",
    "phd": "EK-PHD, whose map is an intensity without identities",
    "genie": "iterated EKF that is told the true association",
    "dead_reckoning": "the controls alone, no path used",
}
