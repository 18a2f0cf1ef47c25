from .five_values import FiveValueEnv as FiveValueEnv
from .five_values import FiveValueParams as FiveValueParams
from .gymnasium_env import UavMecGymEnv as UavMecGymEnv
from .sb3_vec_env import UavMecSB3VecEnv as UavMecSB3VecEnv
from .vector_env import UavMecVectorEnv as UavMecVectorEnv

ENV_ID: str = "UavMec-v0"
