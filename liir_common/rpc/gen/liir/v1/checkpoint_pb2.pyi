from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Checkpoint(_message.Message):
    __slots__ = ("episode", "policy_version", "env_steps", "sha256", "size_bytes")
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    POLICY_VERSION_FIELD_NUMBER: _ClassVar[int]
    ENV_STEPS_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    SIZE_BYTES_FIELD_NUMBER: _ClassVar[int]
    episode: int
    policy_version: int
    env_steps: int
    sha256: str
    size_bytes: int
    def __init__(self, episode: _Optional[int] = ..., policy_version: _Optional[int] = ..., env_steps: _Optional[int] = ..., sha256: _Optional[str] = ..., size_bytes: _Optional[int] = ...) -> None: ...

class ListCheckpointsRequest(_message.Message):
    __slots__ = ("after_episode", "limit")
    AFTER_EPISODE_FIELD_NUMBER: _ClassVar[int]
    LIMIT_FIELD_NUMBER: _ClassVar[int]
    after_episode: int
    limit: int
    def __init__(self, after_episode: _Optional[int] = ..., limit: _Optional[int] = ...) -> None: ...

class ListCheckpointsResponse(_message.Message):
    __slots__ = ("checkpoints",)
    CHECKPOINTS_FIELD_NUMBER: _ClassVar[int]
    checkpoints: _containers.RepeatedCompositeFieldContainer[Checkpoint]
    def __init__(self, checkpoints: _Optional[_Iterable[_Union[Checkpoint, _Mapping]]] = ...) -> None: ...

class GetCheckpointRequest(_message.Message):
    __slots__ = ("episode", "offset")
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    episode: int
    offset: int
    def __init__(self, episode: _Optional[int] = ..., offset: _Optional[int] = ...) -> None: ...

class GetCheckpointResponse(_message.Message):
    __slots__ = ("header", "chunk")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    header: CheckpointHeader
    chunk: bytes
    def __init__(self, header: _Optional[_Union[CheckpointHeader, _Mapping]] = ..., chunk: _Optional[bytes] = ...) -> None: ...

class CheckpointHeader(_message.Message):
    __slots__ = ("checkpoint", "manifest_json")
    CHECKPOINT_FIELD_NUMBER: _ClassVar[int]
    MANIFEST_JSON_FIELD_NUMBER: _ClassVar[int]
    checkpoint: Checkpoint
    manifest_json: str
    def __init__(self, checkpoint: _Optional[_Union[Checkpoint, _Mapping]] = ..., manifest_json: _Optional[str] = ...) -> None: ...

class WatchCheckpointsRequest(_message.Message):
    __slots__ = ("after_episode",)
    AFTER_EPISODE_FIELD_NUMBER: _ClassVar[int]
    after_episode: int
    def __init__(self, after_episode: _Optional[int] = ...) -> None: ...

class WatchCheckpointsResponse(_message.Message):
    __slots__ = ("checkpoint",)
    CHECKPOINT_FIELD_NUMBER: _ClassVar[int]
    checkpoint: Checkpoint
    def __init__(self, checkpoint: _Optional[_Union[Checkpoint, _Mapping]] = ...) -> None: ...

class EpisodeStats(_message.Message):
    __slots__ = ("episodes", "wins", "return_mean", "length_mean", "info_means")
    class InfoMeansEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    EPISODES_FIELD_NUMBER: _ClassVar[int]
    WINS_FIELD_NUMBER: _ClassVar[int]
    RETURN_MEAN_FIELD_NUMBER: _ClassVar[int]
    LENGTH_MEAN_FIELD_NUMBER: _ClassVar[int]
    INFO_MEANS_FIELD_NUMBER: _ClassVar[int]
    episodes: int
    wins: int
    return_mean: float
    length_mean: float
    info_means: _containers.ScalarMap[str, float]
    def __init__(self, episodes: _Optional[int] = ..., wins: _Optional[int] = ..., return_mean: _Optional[float] = ..., length_mean: _Optional[float] = ..., info_means: _Optional[_Mapping[str, float]] = ...) -> None: ...

class Evaluation(_message.Message):
    __slots__ = ("episode", "sha256", "env_steps", "greedy", "sampled")
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    ENV_STEPS_FIELD_NUMBER: _ClassVar[int]
    GREEDY_FIELD_NUMBER: _ClassVar[int]
    SAMPLED_FIELD_NUMBER: _ClassVar[int]
    episode: int
    sha256: str
    env_steps: int
    greedy: EpisodeStats
    sampled: EpisodeStats
    def __init__(self, episode: _Optional[int] = ..., sha256: _Optional[str] = ..., env_steps: _Optional[int] = ..., greedy: _Optional[_Union[EpisodeStats, _Mapping]] = ..., sampled: _Optional[_Union[EpisodeStats, _Mapping]] = ...) -> None: ...

class ReportEvaluationRequest(_message.Message):
    __slots__ = ("evaluation",)
    EVALUATION_FIELD_NUMBER: _ClassVar[int]
    evaluation: Evaluation
    def __init__(self, evaluation: _Optional[_Union[Evaluation, _Mapping]] = ...) -> None: ...

class ReportEvaluationResponse(_message.Message):
    __slots__ = ("duplicate",)
    DUPLICATE_FIELD_NUMBER: _ClassVar[int]
    duplicate: bool
    def __init__(self, duplicate: _Optional[bool] = ...) -> None: ...

class ListEvaluationsRequest(_message.Message):
    __slots__ = ("after_episode", "limit")
    AFTER_EPISODE_FIELD_NUMBER: _ClassVar[int]
    LIMIT_FIELD_NUMBER: _ClassVar[int]
    after_episode: int
    limit: int
    def __init__(self, after_episode: _Optional[int] = ..., limit: _Optional[int] = ...) -> None: ...

class ListEvaluationsResponse(_message.Message):
    __slots__ = ("evaluations",)
    EVALUATIONS_FIELD_NUMBER: _ClassVar[int]
    evaluations: _containers.RepeatedCompositeFieldContainer[Evaluation]
    def __init__(self, evaluations: _Optional[_Iterable[_Union[Evaluation, _Mapping]]] = ...) -> None: ...
