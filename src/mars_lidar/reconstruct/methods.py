"""The methods of reconstruction by name."""

from mars_lidar.reconstruct.centroid import Centroid
from mars_lidar.reconstruct.coates import Coates, GeneralisedCoates
from mars_lidar.reconstruct.matched_filter import MatchedFilter, Peak
from mars_lidar.reconstruct.maximum_likelihood import MaximumLikelihood
from mars_lidar.reconstruct.mchc import ChainCorrection
from mars_lidar.reconstruct.method import Method

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
