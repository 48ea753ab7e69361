"""Results for other programs: a sink that sends them, and the messages of which every kind of stream is made."""

from morph_dslam.streams.messages import (
    FrameMessage as FrameMessage,
    InnerInfo as InnerInfo,
    ObjectInfo as ObjectInfo,
    ObjectMessage as ObjectMessage,
    ParameterInfo as ParameterInfo,
    Publisher as Publisher,
    ReactionMessage as ReactionMessage,
    ScalarInfo as ScalarInfo,
    SceneMessage as SceneMessage,
)
from morph_dslam.tracking.stream_sink import StreamedObject as StreamedObject, StreamSink as StreamSink
