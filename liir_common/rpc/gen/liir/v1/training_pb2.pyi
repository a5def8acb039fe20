from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Phase(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    PHASE_UNSPECIFIED: _ClassVar[Phase]
    PHASE_COLLECTING: _ClassVar[Phase]
    PHASE_UPDATING: _ClassVar[Phase]
    PHASE_EVALUATING: _ClassVar[Phase]
    PHASE_STOPPING: _ClassVar[Phase]
    PHASE_COMPLETE: _ClassVar[Phase]
PHASE_UNSPECIFIED: Phase
PHASE_COLLECTING: Phase
PHASE_UPDATING: Phase
PHASE_EVALUATING: Phase
PHASE_STOPPING: Phase
PHASE_COMPLETE: Phase

class GetRunRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class GetRunResponse(_message.Message):
    __slots__ = ("run_id", "config_json", "env_spec_hash", "build")
    RUN_ID_FIELD_NUMBER: _ClassVar[int]
    CONFIG_JSON_FIELD_NUMBER: _ClassVar[int]
    ENV_SPEC_HASH_FIELD_NUMBER: _ClassVar[int]
    BUILD_FIELD_NUMBER: _ClassVar[int]
    run_id: str
    config_json: str
    env_spec_hash: str
    build: str
    def __init__(self, run_id: _Optional[str] = ..., config_json: _Optional[str] = ..., env_spec_hash: _Optional[str] = ..., build: _Optional[str] = ...) -> None: ...

class GetStatusRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class GetStatusResponse(_message.Message):
    __slots__ = ("phase", "learner_step", "env_steps", "total_env_steps", "episodes", "actors", "tickets_outstanding", "checkpoints", "evaluations", "env_steps_per_second", "metrics")
    class MetricsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    PHASE_FIELD_NUMBER: _ClassVar[int]
    LEARNER_STEP_FIELD_NUMBER: _ClassVar[int]
    ENV_STEPS_FIELD_NUMBER: _ClassVar[int]
    TOTAL_ENV_STEPS_FIELD_NUMBER: _ClassVar[int]
    EPISODES_FIELD_NUMBER: _ClassVar[int]
    ACTORS_FIELD_NUMBER: _ClassVar[int]
    TICKETS_OUTSTANDING_FIELD_NUMBER: _ClassVar[int]
    CHECKPOINTS_FIELD_NUMBER: _ClassVar[int]
    EVALUATIONS_FIELD_NUMBER: _ClassVar[int]
    ENV_STEPS_PER_SECOND_FIELD_NUMBER: _ClassVar[int]
    METRICS_FIELD_NUMBER: _ClassVar[int]
    phase: Phase
    learner_step: int
    env_steps: int
    total_env_steps: int
    episodes: int
    actors: int
    tickets_outstanding: int
    checkpoints: int
    evaluations: int
    env_steps_per_second: float
    metrics: _containers.ScalarMap[str, float]
    def __init__(self, phase: _Optional[_Union[Phase, str]] = ..., learner_step: _Optional[int] = ..., env_steps: _Optional[int] = ..., total_env_steps: _Optional[int] = ..., episodes: _Optional[int] = ..., actors: _Optional[int] = ..., tickets_outstanding: _Optional[int] = ..., checkpoints: _Optional[int] = ..., evaluations: _Optional[int] = ..., env_steps_per_second: _Optional[float] = ..., metrics: _Optional[_Mapping[str, float]] = ...) -> None: ...

class StopRequest(_message.Message):
    __slots__ = ("reason",)
    REASON_FIELD_NUMBER: _ClassVar[int]
    reason: str
    def __init__(self, reason: _Optional[str] = ...) -> None: ...

class StopResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...
