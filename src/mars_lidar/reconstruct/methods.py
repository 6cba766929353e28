"""The methods of reconstruction by name."""

from mars_lidar.reconstruct.centroid import Centroid
from mars_lidar.reconstruct.coates import Coates
from mars_lidar.reconstruct.generalised_coates import GeneralisedCoates
from mars_lidar.reconstruct.matched_filter import MatchedFilter
from mars_lidar.reconstruct.maximum_likelihood import MaximumLikelihood
from mars_lidar.reconstruct.mchc import ChainCorrection
from mars_lidar.reconstruct.method import Method
from mars_lidar.reconstruct.peak import Peak

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        MaximumLikelihood(),
        GeneralisedCoates(),
        ChainCorrection(),
        Coates(),
        MatchedFilter(),
        Centroid(),
        Peak(),
    )
}
