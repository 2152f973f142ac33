"""Training of one policy: interruptible and resumable."""

import csv
import hashlib
import io
import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from tint_sumo import traits as trait_models
from tint_sumo.config import LATENT_SIZE, PERFECT, SEEDS, SNAPSHOTS_PERCENT, Mix, PpoSettings, Sensor
from tint_sumo.core.checkpoints import remove_checkpoint, write_checkpoint
from tint_sumo.core.determinism import preserved_random_state, single_threaded
from tint_sumo.core.errors import DivergedError, InputError, NotFiniteError
from tint_sumo.core.files import claim_folder, write_text
from tint_sumo.core.progress import Progress, Report, silent
from tint_sumo.core.provenance import versions
from tint_sumo.core.structures import plain
from tint_sumo.core.training_log import log_film, open_log
from tint_sumo.core.weights import card_file, weights_file
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.rows import outcomes_in
from tint_sumo.methods.calibration import Calibration, calibrate
from tint_sumo.methods.checkpoint import make_checkpoint, restore_checkpoint
from tint_sumo.methods.evaluation import CASE_SEED
from tint_sumo.methods.registry import Learned, find_learned
from tint_sumo.policy import GruPolicy, RecurrentPPO
from tint_sumo.policy.storage import load_policy_network, read_policy_card, save_policy
from tint_sumo.policy.wrappers import policy_venv
from tint_sumo.scenes import T_INTERSECTION, AnyScene, described, find_scenes, require_trait_steps
from tint_sumo.scenes.drivers import require_two_kinds
from tint_sumo.traits import TraitModel
from tint_sumo.traits.storage import read_card, require_scene, save, shipped_model

FilmMaker = Callable[[Path], bytes | None]  # a GIF of the policy in a file; None where there can be none

CHECKPOINT_INTERVAL_S = 15.0
STATE_INTERVAL_S = 1.0  # an interrupted training loses as much work; making the state takes up to 30 ms
POLICY = "policy"  # name of the policy in the folder of a run
ZIP_FILE = "policy.zip"
CURVE_FILE = "curve.csv"
TRAITS = "traits"  # name of the trait model beside a policy
RECENT_EPISODES = 500
_MOST_SIMULATIONS = 32  # environments of a training in a SUMO configuration


def snapshot_stem(out: Path, percent: int) -> Path:
    """Return the path of a run's policy after some percent of the training, without suffix."""
    return out / (POLICY if percent == 100 else f"{POLICY}-{percent}")


def train_policy(
    method: str,
    p_conservative: Mix | None,
    steps: int,
    seed: int,
    out: Path,
    *,
    settings: PpoSettings,
    scene: str | AnyScene = T_INTERSECTION,
    sensors: Sequence[Sensor] = (PERFECT,),
    traits: str | Path | None = None,
    other_scene: bool = False,
    with_zip: bool = False,
    film: FilmMaker | None = None,
    report: Report = silent,
) -> Path:
    """Train a policy and write it as policy.safetensors with its card policy.json.

    Beside them stand the policies after 25 and 50 % of the training, the training's curve (outcomes of the last
    episodes by decisions), a TensorBoard log and, where the method infers traits, its trait model. An interrupted run
    leaves a checkpoint, and the same call goes on from there. A finished run is not repeated. With
    ``calibration_episodes`` the trained policy is calibrated at the end (``tint_sumo.methods.calibration``).

    On a CPU the policy follows from the arguments alone: the training computes in one thread, nobody who looks on
    changes its random numbers, and the process's own are as before when it ends.

    Args:
        method: name of a learned method.
        p_conservative: mix of the drivers it trains among; None in a SUMO configuration, whose demand says who drives.
        steps: decisions of the policy, at least; training ends with a whole rollout.
        seed: of weights, actions and environments, 0 to 1000.
        out: a new folder, or the one of this very run.
        settings: network and PPO; its ``total_steps`` is not used.
        scene: the scene it trains in, or ``"all"``.
        sensors: with which the egos perceive the others; of several, each has an equal share of the environments.
        traits: trait model by name or path, for methods that infer traits; the shipped one if not given.
        other_scene: take a trait model that was trained in another scene, too.
        with_zip: write the policy as Stable-Baselines3's policy.zip, too.
        film: makes a GIF of the policy in a file, for the TensorBoard log, such as
            ``tint_sumo.films.training_films.film_policy``; called with each of the kept policies.
        report: called with the progress.

    Returns:
        The path of policy.safetensors.

    Raises:
        InputError: bad values, no such method or trait model, ``out`` holds another run, or its checkpoint is damaged.
        DivergedError: a loss, a weight or an output of the policy is not finite; the same call ends so again.
    """
    learned = find_learned(method)
    scenes = find_scenes(scene)
    _require_drivers(learned, p_conservative, scenes[0])
    SEEDS.require("seed", seed)
    if steps < 1:
        raise InputError(f"steps must be at least 1, not {steps}")
    if learned.encoder is None and (traits is not None or other_scene):
        raise InputError(f"method {method} infers no traits; leave `traits` and `other_scene` out")
    encoder = _load_encoder(learned, traits)
    for one in scenes if learned.make_source(encoder, settings).needs_tracks else ():
        require_trait_steps(one)
    trained_in = described(scenes)
    if encoder is not None and not other_scene:
        require_scene(_trait_model(learned, traits), trained_in["scene"], trained_in["scene_digest"], "the policy")
    settings = learned.settings_of(settings)
    places = len(scenes) * len(sensors)
    if places > settings.n_envs:
        raise InputError(
            f"n_envs must be at least {places}, an environment for each scene and sensor, not {settings.n_envs}"
        )
    if places > 1 and settings.calibration_episodes % settings.n_envs:
        raise InputError(
            f"calibration_episodes must be 0 or a multiple of n_envs ({settings.n_envs}), so that all scenes and "
            f"sensors have their share, not {settings.calibration_episodes}"
        )
    if scenes[0].sumocfg and settings.n_envs > _MOST_SIMULATIONS:
        raise InputError(
            f"each environment in a SUMO configuration is a process; n_envs must be at most {_MOST_SIMULATIONS}, not "
            f"{settings.n_envs}"
        )
    identity = {
        "kind": "policy",
        "method": method,
        "p_conservative": None if p_conservative is None else [p_conservative.low, p_conservative.high],
        "steps": steps,
        "seed": seed,
        **trained_in,
        **_sensors_entry(sensors),
        "settings": asdict(settings),
        "traits": None if encoder is None else digest(encoder),
    }
    # The training draws from the global random numbers: those who look on must not.
    report = preserved_random_state()(report)
    film = None if film is None else preserved_random_state()(film)
    stem = snapshot_stem(out, 100)
    with claim_folder(out, identity, with_versions=False):  # the card has them
        if with_zip and card_file(stem).exists() and not (out / ZIP_FILE).exists():
            raise InputError(f"{out} holds a finished run without {ZIP_FILE}; train into another folder to have one")
        if not card_file(stem).exists():
            if encoder is not None:
                save(encoder, out / TRAITS, read_card(_trait_model(learned, traits)).entries)
            card = _card(identity, encoder)

            def make_venv() -> VecEnv:
                return training_venv(learned, encoder, p_conservative, settings, scenes, sensors)

            with preserved_random_state(), single_threaded():
                with closing(make_venv()) as venv:
                    model = _learn(venv, outcomes_in(scenes[0]), steps, seed, out, settings, card, film, report)
                if settings.calibration_episodes:
                    card |= {"calibration": asdict(calibrated(model.policy, make_venv, seed, settings, report))}
            if with_zip:
                model.save(out / ZIP_FILE)
            _keep_policy(model, stem, card, film)
            remove_checkpoint(out)
        return stem.with_suffix(".safetensors")


def share_training(source: Path, method: str, out: Path, traits: str | Path | None = None) -> None:
    """Write the policies of a finished run as those of a method that is trained in the same way.

    Args:
        source: folder of the run.
        method: one that is ``trained_as`` that run's method, and drives with other traits.
        out: a new folder, or the one of this very call.
        traits: trait model by name or path; the shipped one if not given.
    """
    learned = find_learned(method)
    encoder = _load_encoder(learned, traits)
    assert encoder is not None
    shared = read_policy_card(snapshot_stem(source, 100))
    training = {key: shared[key] for key in ("method", "p_conservative", "steps", "seed", "scene")}
    with claim_folder(out, {"kind": "policy", "method": method, "traits": digest(encoder), "training": training}):
        save(encoder, out / TRAITS, read_card(_trait_model(learned, traits)).entries)
        for percent in (*SNAPSHOTS_PERCENT, 100):
            stem = snapshot_stem(source, percent)
            entries = {"method": method, "trained_as": learned.trained_as} | _traits_entries(encoder)
            save_policy(load_policy_network(stem), snapshot_stem(out, percent), {**read_policy_card(stem), **entries})


def _require_drivers(learned: Learned, p_conservative: Mix | None, scene: AnyScene) -> None:
    """Raise InputError unless a method can be trained among a scene's drivers, in such a mix."""
    kinds = len(scene.with_drivers(p_conservative, None).traits)
    if learned.sees_true_traits:
        require_two_kinds(kinds, f"method {learned.name}", f"scene {scene.name}")


def _sensors_entry(sensors: Sequence[Sensor]) -> dict[str, Any]:
    """Return the card's entry about the sensors of a training."""
    if len(sensors) > 1:
        return {"sensors": [plain(sensor) for sensor in sensors]}
    return {} if sensors[0] == PERFECT else {"sensor": plain(sensors[0])}


def _load_encoder(learned: Learned, traits: str | Path | None) -> TraitModel | None:
    if learned.encoder is None:
        return None
    encoder = trait_models.load(_trait_model(learned, traits), latent_size=LATENT_SIZE)
    if encoder.method != learned.encoder:
        raise InputError(
            f"method {learned.name} needs a trait model of the method {learned.encoder}, not of {encoder.method}; "
            "give such a model as `traits`"
        )
    return encoder


def _trait_model(learned: Learned, traits: str | Path | None) -> str | Path:
    """Return the trait model to take, by name or path: the given one, else the shipped one of the method."""
    return traits or shipped_model(str(learned.encoder))


def training_venv(
    learned: Learned,
    encoder: TraitModel | None,
    p_conservative: Mix | None,
    settings: PpoSettings,
    scenes: Sequence[AnyScene],
    sensors: Sequence[Sensor] = (PERFECT,),
) -> VecEnv:
    """Return environments with the traits that the method is trained with."""
    time_limit_s = min(settings.time_limit_s, *(scene.time_limit_s for scene in scenes))
    shown = learned if learned.trained_as is None else find_learned(learned.trained_as)
    return policy_venv(
        settings.n_envs,
        shown.make_source(encoder if shown.encoder else None, settings),
        [
            TaskSettings(scene, p_conservative, settings.reward, time_limit_s, sensor)
            for scene in scenes
            for sensor in sensors
        ],
        action_repeat=settings.action_repeat,
        critic_sees_true_traits=learned.critic_sees_true_traits,
        monitored=True,
    )


def _learn(
    venv: VecEnv,
    outcomes: tuple[str, ...],
    steps: int,
    seed: int,
    out: Path,
    settings: PpoSettings,
    card: Mapping[str, Any],
    film: FilmMaker | None,
    report: Report,
) -> RecurrentPPO:
    """Train from the checkpoint, if there is one, to ``steps``."""
    model = new_model(venv, seed, settings)
    venv.seed(_training_seed(seed))
    recent = restore_checkpoint(out, model)
    done = model.num_timesteps
    logged = {key: card[key] for key in ("method", "p_conservative", "scene", "seed", "steps", "settings")}
    model.set_logger(open_log(out, logged, [f"rollout/{outcome}" for outcome in outcomes], done))
    if done < steps:
        report(Progress(done, steps, "step"))
        watch = _Watch(out, outcomes, steps, card, film, report, recent)
        try:
            model.learn(steps - done, callback=watch, reset_num_timesteps=False)
        except KeyboardInterrupt:
            watch.write_checkpoint()
            raise
        except DivergedError as error:
            watch.write_checkpoint()
            raise DivergedError(f"{error}; {out} holds a checkpoint of before that") from None
    return model


def calibrated(
    policy: GruPolicy, make_venv: Callable[[], VecEnv], seed: int, settings: PpoSettings, report: Report = silent
) -> Calibration:
    """Calibrate a policy at the end of its training, in episodes that the training has not had.

    ``make_venv`` makes the environments of the training, all of them, so that each scene and sensor has its share.
    """
    first_seed = CASE_SEED // 2 + _training_seed(seed) // 2
    return calibrate(policy, lambda _: make_venv(), first_seed, settings.calibration_episodes, settings.n_envs, report)


def _keep_policy(model: BaseAlgorithm, stem: Path, card: Mapping[str, Any], film: FilmMaker | None) -> None:
    """Write the policy as it is now, and log a film of it.

    Raises:
        DivergedError: its outputs are not finite; it is not kept then.
    """
    assert isinstance(model.policy, GruPolicy)
    try:
        save_policy(model.policy, stem, card)
        gif = None if film is None else film(weights_file(stem))
    except NotFiniteError:
        card_file(stem).unlink(missing_ok=True)  # so that the same command comes to the same end
        raise DivergedError(
            f"the training diverged at step {model.num_timesteps}: the policy's outputs are not finite; "
            "choose a lower learning_rate"
        ) from None
    if gif is not None:
        log_film(model.logger, "film", gif, model.num_timesteps)


def new_model(venv: VecEnv, seed: int, settings: PpoSettings) -> RecurrentPPO:
    return RecurrentPPO(
        "GruPolicy",
        venv,
        learning_rate=LinearSchedule(settings.learning_rate, 0.0, 1.0),
        n_steps=settings.n_steps,
        n_minibatches=settings.n_minibatches,
        n_epochs=settings.n_epochs,
        gamma=settings.gamma,
        gae_lambda=settings.gae_lambda,
        clip_range=settings.clip_range,
        ent_coef=LinearSchedule(settings.ent_coef, settings.final_ent_coef, 1.0),
        vf_coef=settings.vf_coef,
        max_grad_norm=settings.max_grad_norm,
        policy_kwargs={"settings": settings.policy},
        seed=seed,
    )


def _training_seed(seed: int) -> int:
    """Return the seed of the first environment; below every case's seed."""
    sequence = np.random.SeedSequence((seed, 0))  # of two numbers, as when the shipped policies were trained
    return int(sequence.generate_state(1)[0]) % (CASE_SEED // 2)


class _Watch(BaseCallback):
    """Keeps checkpoints, snapshots and the curve of the training, and reports the outcomes of recent episodes.

    A checkpoint is the state between two rollouts: within one, steps are counted from which nothing is learnt yet. So
    it is made before it is known whether it will be needed, but not before each of many short rollouts.
    """

    def __init__(
        self,
        out: Path,
        outcomes: tuple[str, ...],
        steps: int,
        card: Mapping[str, Any],
        film: FilmMaker | None,
        report: Report,
        recent: tuple[str, ...],
    ) -> None:
        super().__init__()
        self._out = out
        self._outcomes = outcomes
        self._steps = steps
        self._card = card
        self._film = film
        self._report = report
        self._recent: deque[str] = deque(recent, maxlen=RECENT_EPISODES)
        self._saved_at = time.monotonic()
        self._made_at = -math.inf
        self._state = b""
        self._curve: list[list[str]] = []

    def _on_training_start(self) -> None:
        """Go on with the curve up to the checkpoint."""
        rows = read_curve(self._out) if self.num_timesteps else []
        self._curve = [row for row in rows if int(row[0]) <= self.num_timesteps]

    def _on_rollout_start(self) -> None:
        assert isinstance(self.model, RecurrentPPO)
        if time.monotonic() - self._made_at >= STATE_INTERVAL_S:
            self._state = make_checkpoint(self.model, self._recent)
            self._made_at = time.monotonic()
        if time.monotonic() - self._saved_at >= CHECKPOINT_INTERVAL_S:
            self.write_checkpoint()
            self._saved_at = time.monotonic()
        self._keep_snapshots()

    def _keep_snapshots(self) -> None:
        for percent in SNAPSHOTS_PERCENT:
            stem = snapshot_stem(self._out, percent)
            if self.num_timesteps * 100 >= percent * self._steps and not card_file(stem).exists():
                card = {**self._card, "decisions": self.num_timesteps}
                _keep_policy(self.model, stem, card, self._film)

    def write_checkpoint(self) -> None:
        """Write the state at the start of the present rollout, if there is one."""
        if self._state:
            self._write_curve()
            write_checkpoint(self._out, self._state)

    def _write_curve(self) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([("decisions", *self._outcomes), *self._curve])
        write_text(self._out / CURVE_FILE, text.getvalue())

    def _on_step(self) -> bool:
        infos: list[dict[str, Any]] = self.locals["infos"]
        self._recent.extend(infos[index]["outcome"] for index in np.flatnonzero(self.locals["dones"]))
        return True

    def _on_rollout_end(self) -> None:
        measures: dict[str, float] = {}
        if self._recent:
            shares = {outcome: self._recent.count(outcome) / len(self._recent) for outcome in self._outcomes}
            for outcome, share in shares.items():
                self.logger.record(f"rollout/{outcome}", share)
            self._curve.append([str(self.num_timesteps), *(f"{share:.4f}" for share in shares.values())])
            measures = {outcome: shares[outcome] for outcome in ("success", "collision")}
        self._report(Progress(min(self.num_timesteps, self._steps), self._steps, "step", measures))

    def _on_training_end(self) -> None:
        self._write_curve()
        self._keep_snapshots()  # those that only the last rollout has reached


def read_curve(out: Path) -> list[list[str]]:
    """Return the rows of a training's curve: decisions, then shares of outcomes; none if there is no file yet."""
    try:
        lines = (out / CURVE_FILE).read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return []
    return list(csv.reader(lines[1:]))


def digest(encoder: TraitModel) -> str:
    """Return a checksum of a trait model's weights."""
    return hashlib.sha256(safetensors.torch.save(encoder.state_dict())).hexdigest()


def _traits_entries(encoder: TraitModel | None) -> dict[str, Any]:
    """Return the card's entries about the trait model beside the policy."""
    if encoder is None:
        return {"traits": None, "traits_sha256": None}
    return {"traits": TRAITS, "traits_sha256": digest(encoder)}


def _card(identity: Mapping[str, Any], encoder: TraitModel | None) -> dict[str, Any]:
    packages = ("tint_sumo", "libsumo", "torch", "stable-baselines3", "gymnasium", "numpy")
    return {
        **{key: value for key, value in identity.items() if key != "kind"},
        **_traits_entries(encoder),
        "versions": versions(packages),
    }
