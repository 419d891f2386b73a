"""Allan variance and its relatives: estimators, cluster times, and the covariance of the estimates."""
