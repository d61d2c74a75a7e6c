"""Modules for scene models of your own: the growing encoding of points, gamma, decoders, and all of them together."""

from snh.nn.decoder import Decoder as Decoder
from snh.nn.decoder import FrequencyEncoding as FrequencyEncoding
from snh.nn.encoding import PlaneHashEncoding as PlaneHashEncoding
from snh.nn.encoding import follow_growth as follow_growth
from snh.nn.scene import SceneField as SceneField
