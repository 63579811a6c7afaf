# The public names of magpend. Each is imported from the module that is given here, when it is first used.

from magpend._runs import Run as Run
from magpend._runs import open_run as open_run
from magpend._runs import run as run
from magpend._runs import table as table
from magpend_core.engine.system import System as System
from magpend_core.lyapunov import LyapunovExponents as LyapunovExponents
from magpend_core.lyapunov import lyapunov_exponents as lyapunov_exponents
from magpend_core.models import import_object as import_object
from magpend_core.models import load_preset as load_preset
from magpend_core.models import model_names as model_names
from magpend_core.models import preset_names as preset_names
from magpend_core.models.model import Model as Model
from magpend_core.models.model import Parameters as Parameters
from magpend_core.models.parameters import ParameterError as ParameterError
from magpend_core.models.preset_writing import write_preset as write_preset
from magpend_core.orbits import PeriodicOrbits as PeriodicOrbits
from magpend_core.orbits import polish_orbits as polish_orbits
from magpend_core.pointwise import evaluate as evaluate
from magpend_core.pointwise import jacobian as jacobian
from magpend_core.pointwise import rates as rates
from magpend_core.recorded_drive import evaluate_recorded as evaluate_recorded
from magpend_core.recorded_drive import recorded_sections as recorded_sections
from magpend_core.recorded_drive import recorded_trajectory as recorded_trajectory
from magpend_core.sampling import Drive as Drive
from magpend_core.sections import Sections as Sections
from magpend_core.sections import run_branches as run_branches
from magpend_core.sections import sections as sections
from magpend_core.status import Status as Status
from magpend_core.trajectory import trajectory as trajectory
from pipeline.analysis.attractors.figure import plot_gallery as plot_gallery
from pipeline.analysis.basins.figure import plot_basins as plot_basins
from pipeline.analysis.basins.fractions_figure import plot_coexisting as plot_coexisting
from pipeline.analysis.basins.fractions_figure import plot_fractions as plot_fractions
from pipeline.analysis.basins.regimes_figure import plot_curves as plot_curves
from pipeline.analysis.basins.regimes_figure import plot_regimes as plot_regimes
from pipeline.analysis.branches.figure import plot_branches as plot_branches
from pipeline.analysis.branches.figure import plot_multipliers as plot_multipliers
from pipeline.analysis.chaos.convergence_figure import plot_convergence as plot_convergence
from pipeline.analysis.chaos.dimension_figure import plot_dimension as plot_dimension
from pipeline.analysis.chaos.dimensions import correlation_dimension as correlation_dimension
from pipeline.analysis.chaos.dimensions import kaplan_yorke_dimension as kaplan_yorke_dimension
from pipeline.analysis.chaos.lyapunov import spectrum_of_jacobians as spectrum_of_jacobians
from pipeline.analysis.chaos.lyapunov_figure import plot_lyapunov as plot_lyapunov
from pipeline.analysis.chaos.lyapunov_figure import plot_lyapunov_map as plot_lyapunov_map
from pipeline.analysis.chaos.zero_one import zero_one_test as zero_one_test
from pipeline.analysis.manifolds.figure import plot_manifolds as plot_manifolds
from pipeline.analysis.series.analysis import series_of as series_of
from pipeline.analysis.spectrum.estimate import spectrum_of as spectrum_of
from pipeline.compute.simulate import simulate as simulate
from pipeline.explorer.notebook import explorer as explorer
from pipeline.importing.importing import import_model as import_model
from pipeline.plots import DataFigure as DataFigure
from pipeline.plots import Frame as Frame
from pipeline.plots import draw_figure as draw_figure
from pipeline.plots import plot_bifurcation as plot_bifurcation
from pipeline.plots import plot_section as plot_section
from pipeline.plots import plot_trajectory as plot_trajectory
from pipeline.plots import save_data as save_data
from pipeline.plots import save_figure as save_figure
from pipeline.plots.animation import save_animation as save_animation
from pipeline.rig.identify.identification import identify as identify
from pipeline.rig.recordings import findings_of as findings_of
from pipeline.rig.recordings import load_mapping as load_mapping
from pipeline.rig.recordings import read_recording as read_recording
from pipeline.rig.recordings import smooth as smooth
from pipeline.rig.recordings import window as window
from pipeline.rig.recordings import write_recording as write_recording
from pipeline.rig.recordings.figure import plot_recording as plot_recording
from pipeline.runs.derive import derive as derive
from pipeline.runs.derive import prune as prune
from pipeline.runs.drawing import figure as figure
from pipeline.runs.environment import show_versions as show_versions
from pipeline.runs.extend import extend as extend
from pipeline.runs.filming import animation as animation
from pipeline.runs.preview import preview as preview
from pipeline.runs.status import state as state
from pipeline.runs.verify import verify_run as verify_run
from pipeline.runs.zoom import zoom as zoom
from pipeline.specification.models import load_model as load_model
from pipeline.specification.models import model as model
from pipeline.specification.problems import SpecError as SpecError
from pipeline.specification.recorded_drive import load_drive as load_drive
from pipeline.specification.spec import Spec as Spec

__version__: str

# analyses, made by python -m pipeline.cli.reference
attractors = Run.attractors
settling = Run.settling
hysteresis = Run.hysteresis
basins = Run.basins
resilience = Run.resilience
edge = Run.edge
transfer = Run.transfer
overlaps = Run.overlaps
chaos = Run.chaos
dimension = Run.dimension
spectrum = Run.spectrum
series = Run.series
branches = Run.branches
phase = Run.phase
events = Run.events
response = Run.response
backbone = Run.backbone
bands = Run.bands
sensitivities = Run.sensitivities
curves = Run.curves
atlas = Run.atlas
orbits = Run.orbits
tongues = Run.tongues
manifolds = Run.manifolds
tangency = Run.tangency
tipping = Run.tipping
delay = Run.delay
escapes = Run.escapes
density = Run.density
