"""The joint law of the bins: by classifiers, by its covariance in closed form, by windows and neighbours."""
