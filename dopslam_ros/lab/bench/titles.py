"""The benchmarks and what each does, in a sentence; ``suite`` measures them."""

TITLES = {
    "step": "A step on the paper's scene, correlations kept, gamma 10.",
    "marginal": "A step on the paper's scene, correlations dropped as in the paper, gamma 10.",
    "map": "A step with 10 landmarks in view and a map that grows out of view.",
    "view": "A step with ever more landmarks in view and as many paths in a set.",
    "study": "A study of the paper's scene with and without Doppler, with bounds, on all cores.",
    "replay": "A bag of the paper's scene replayed, MCAP read and written, start-up excluded.",
    "nodes": "The filter node in a process of its own at 100 Hz, all it says subscribed to.",
    "recorder": "The recorder node in a process of its own, 1,000 sets and controls a second.",
    "overload": "The filter node in a process of its own, ten times the sets that it can answer.",
    "memory": "Memory and covariance of a filter that never stops.",
    "soak": "Two hours of a scene at 10 Hz from a bag, twice: memory, times and results.",
    "ready": 'The filter node from its start to "ready", first and later starts.',
    "bounds": "A step of the bounds, with and without Doppler, 8 landmarks.",
    "gospa": "GOSPA of 8 landmarks beside Stone Soup's.",
    "assignment": "The best associations of 8 paths, as an 8 x 17 problem, beside SciPy's.",
}
