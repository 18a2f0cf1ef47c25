from .chunks import Validation as Validation
from .host import use_all_cores as use_all_cores
from .population import Progress as Progress
from .sweep import TrainedPopulation as TrainedPopulation
from .sweep import train as train
from .trained_shard import TrainedShard as TrainedShard
