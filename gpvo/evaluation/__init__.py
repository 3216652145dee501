"""Judging runs and stated covariances: scores, verdicts, plots, reports and the scoreboard."""
