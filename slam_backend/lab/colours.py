"""One colour for one thing, in every picture and on every page."""

ODOMETRY, ONLINE, SMOOTHED, TRUTH = "#d9822b", "#8e6bbf", "#1f4e9c", "#333333"
OTHERS = ("#2a9d9d", "#b5527a", "#7a8f2a")
LOOP, PROBATION, REFUSED, LANDMARK = "#3c9a5f", "#c9a227", "#c0392b", "#555555"
VERDICTS = {
    "accepted": LOOP,
    "restored": LOOP,
    "probation": PROBATION,
    "refused": REFUSED,
    "removed": REFUSED,
}
