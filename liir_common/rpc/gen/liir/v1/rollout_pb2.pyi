from liir_common.rpc.gen.liir.v1 import tensor_pb2 as _tensor_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Exploration(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    EXPLORATION_UNSPECIFIED: _ClassVar[Exploration]
    EXPLORATION_SOFTMAX_FLOOR: _ClassVar[Exploration]
    EXPLORATION_EPSILON_GREEDY: _ClassVar[Exploration]
    EXPLORATION_GREEDY: _ClassVar[Exploration]
EXPLORATION_UNSPECIFIED: Exploration
EXPLORATION_SOFTMAX_FLOOR: Exploration
EXPLORATION_EPSILON_GREEDY: Exploration
EXPLORATION_GREEDY: Exploration

class PlayRequest(_message.Message):
    __slots__ = ("hello", "ready", "trajectories")
    HELLO_FIELD_NUMBER: _ClassVar[int]
    READY_FIELD_NUMBER: _ClassVar[int]
    TRAJECTORIES_FIELD_NUMBER: _ClassVar[int]
    hello: Hello
    ready: Ready
    trajectories: _containers.RepeatedCompositeFieldContainer[Trajectory]
    def __init__(self, hello: _Optional[_Union[Hello, _Mapping]] = ..., ready: _Optional[_Union[Ready, _Mapping]] = ..., trajectories: _Optional[_Iterable[_Union[Trajectory, _Mapping]]] = ...) -> None: ...

class PlayResponse(_message.Message):
    __slots__ = ("policy", "tickets", "acks", "drain")
    POLICY_FIELD_NUMBER: _ClassVar[int]
    TICKETS_FIELD_NUMBER: _ClassVar[int]
    ACKS_FIELD_NUMBER: _ClassVar[int]
    DRAIN_FIELD_NUMBER: _ClassVar[int]
    policy: Policy
    tickets: _containers.RepeatedCompositeFieldContainer[Ticket]
    acks: _containers.RepeatedCompositeFieldContainer[Ack]
    drain: Drain
    def __init__(self, policy: _Optional[_Union[Policy, _Mapping]] = ..., tickets: _Optional[_Iterable[_Union[Ticket, _Mapping]]] = ..., acks: _Optional[_Iterable[_Union[Ack, _Mapping]]] = ..., drain: _Optional[_Union[Drain, _Mapping]] = ...) -> None: ...

class Hello(_message.Message):
    __slots__ = ("actor_id", "incarnation", "env_spec_hash", "build")
    ACTOR_ID_FIELD_NUMBER: _ClassVar[int]
    INCARNATION_FIELD_NUMBER: _ClassVar[int]
    ENV_SPEC_HASH_FIELD_NUMBER: _ClassVar[int]
    BUILD_FIELD_NUMBER: _ClassVar[int]
    actor_id: str
    incarnation: int
    env_spec_hash: str
    build: str
    def __init__(self, actor_id: _Optional[str] = ..., incarnation: _Optional[int] = ..., env_spec_hash: _Optional[str] = ..., build: _Optional[str] = ...) -> None: ...

class Ready(_message.Message):
    __slots__ = ("tickets",)
    TICKETS_FIELD_NUMBER: _ClassVar[int]
    tickets: int
    def __init__(self, tickets: _Optional[int] = ...) -> None: ...

class Policy(_message.Message):
    __slots__ = ("version", "tensors")
    VERSION_FIELD_NUMBER: _ClassVar[int]
    TENSORS_FIELD_NUMBER: _ClassVar[int]
    version: int
    tensors: _containers.RepeatedCompositeFieldContainer[_tensor_pb2.NamedTensor]
    def __init__(self, version: _Optional[int] = ..., tensors: _Optional[_Iterable[_Union[_tensor_pb2.NamedTensor, _Mapping]]] = ...) -> None: ...

class Ticket(_message.Message):
    __slots__ = ("episode_id", "policy_version", "seed", "exploration", "epsilon")
    EPISODE_ID_FIELD_NUMBER: _ClassVar[int]
    POLICY_VERSION_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    EXPLORATION_FIELD_NUMBER: _ClassVar[int]
    EPSILON_FIELD_NUMBER: _ClassVar[int]
    episode_id: int
    policy_version: int
    seed: int
    exploration: Exploration
    epsilon: float
    def __init__(self, episode_id: _Optional[int] = ..., policy_version: _Optional[int] = ..., seed: _Optional[int] = ..., exploration: _Optional[_Union[Exploration, str]] = ..., epsilon: _Optional[float] = ...) -> None: ...

class Trajectory(_message.Message):
    __slots__ = ("episode_id", "policy_version", "obs", "state", "mask", "alive", "actions", "log_mu", "reward", "terminated", "truncated", "info", "stats")
    EPISODE_ID_FIELD_NUMBER: _ClassVar[int]
    POLICY_VERSION_FIELD_NUMBER: _ClassVar[int]
    OBS_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    MASK_FIELD_NUMBER: _ClassVar[int]
    ALIVE_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    LOG_MU_FIELD_NUMBER: _ClassVar[int]
    REWARD_FIELD_NUMBER: _ClassVar[int]
    TERMINATED_FIELD_NUMBER: _ClassVar[int]
    TRUNCATED_FIELD_NUMBER: _ClassVar[int]
    INFO_FIELD_NUMBER: _ClassVar[int]
    STATS_FIELD_NUMBER: _ClassVar[int]
    episode_id: int
    policy_version: int
    obs: _tensor_pb2.Tensor
    state: _tensor_pb2.Tensor
    mask: _tensor_pb2.Tensor
    alive: _tensor_pb2.Tensor
    actions: _tensor_pb2.Tensor
    log_mu: _tensor_pb2.Tensor
    reward: _tensor_pb2.Tensor
    terminated: bool
    truncated: bool
    info: _containers.RepeatedScalarFieldContainer[float]
    stats: ActorStats
    def __init__(self, episode_id: _Optional[int] = ..., policy_version: _Optional[int] = ..., obs: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., state: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., mask: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., alive: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., actions: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., log_mu: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., reward: _Optional[_Union[_tensor_pb2.Tensor, _Mapping]] = ..., terminated: _Optional[bool] = ..., truncated: _Optional[bool] = ..., info: _Optional[_Iterable[float]] = ..., stats: _Optional[_Union[ActorStats, _Mapping]] = ...) -> None: ...

class ActorStats(_message.Message):
    __slots__ = ("play_seconds", "wait_seconds", "peak_memory_bytes")
    PLAY_SECONDS_FIELD_NUMBER: _ClassVar[int]
    WAIT_SECONDS_FIELD_NUMBER: _ClassVar[int]
    PEAK_MEMORY_BYTES_FIELD_NUMBER: _ClassVar[int]
    play_seconds: float
    wait_seconds: float
    peak_memory_bytes: int
    def __init__(self, play_seconds: _Optional[float] = ..., wait_seconds: _Optional[float] = ..., peak_memory_bytes: _Optional[int] = ...) -> None: ...

class Ack(_message.Message):
    __slots__ = ("episode_id",)
    EPISODE_ID_FIELD_NUMBER: _ClassVar[int]
    episode_id: int
    def __init__(self, episode_id: _Optional[int] = ...) -> None: ...

class Drain(_message.Message):
    __slots__ = ("reason", "run_complete")
    REASON_FIELD_NUMBER: _ClassVar[int]
    RUN_COMPLETE_FIELD_NUMBER: _ClassVar[int]
    reason: str
    run_complete: bool
    def __init__(self, reason: _Optional[str] = ..., run_complete: _Optional[bool] = ...) -> None: ...
