"""What a policy is worth: sampled, exact, and cell by cell."""

# A score below which a run has failed, and the share of its episodes that count as all.
FAILED, NEARLY_ALL = 0.05, 0.99
