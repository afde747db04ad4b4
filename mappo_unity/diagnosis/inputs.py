"""Findings about what comes from the environment: observations, rewards, episodes, masks, agents."""

from __future__ import annotations

from collections.abc import Iterator

from mappo_unity.diagnosis.evidence import Evidence, Facts, Finding, amount, leaves_one_action

_HUGE = 100.0  # of an observation; networks are made for values of about 1
_TINY = 1e-3
_HUGE_RETURN = 100.0  # of a reward, where values are not normalised
_ENOUGH = 5_000  # decisions before anything is said about observations and masks
_LONG = 100_000  # decisions, or half of the run, before anything is said about rewards
_IDLE = 0.1  # of the agents: some of a team may be dead for long
_SHOWN = 4  # elements that a finding names


def from_inputs(evidence: Evidence) -> Iterator[Finding]:
    """Yield what is wrong with what the environment sends, policy by policy."""
    total = sum(facts["decisions"] for facts in evidence.survey.values())
    if total < _ENOUGH:
        return

    for name, facts in evidence.survey.items():
        if not facts["decisions"]:
            # where opponents have played its teams it may be that its turn has not come
            if not facts.get("opposed"):
                yield Finding(
                    "never asked",
                    f"{name} is never asked for a decision",
                    f"0 of {amount(total)} decisions are its own",
                    "are its agents active, with a DecisionRequester and Behavior Type Default?",
                )
            continue
        yield from _observations(evidence, name, facts)
        yield from _masks(name, facts)
        yield from _agents(name, facts)
        yield from _episodes(name, facts)
        is_long = total >= min(_LONG, 0.5 * evidence.number("max_steps"))
        yield from _rewards(evidence, name, facts, is_long)


def _observations(evidence: Evidence, name: str, facts: Facts) -> Iterator[Finding]:
    elements = facts["elements"]
    seen = f"in {amount(facts['decisions'])} decisions"
    for sensor, image in facts["images"].items():
        if image["least"] == image["greatest"]:
            yield Finding(
                "constant",
                f"{name}: the images of {sensor} never change",
                f"every pixel was {amount(image['least'])} {seen}",
                "is the camera active, and are graphics on (env.no_graphics=false)?",
            )
    for sensor, entities in facts.get("sets", {}).items():  # surveys of older versions have none
        if entities["least"] == entities["greatest"] == 0:
            yield Finding(
                "constant",
                f"{name}: {sensor} never holds an entity",
                f"it was empty {seen}",
                "is it filled in (AppendObservation of its BufferSensorComponent, in CollectObservations)?",
            )
    if elements is None:
        return

    least, greatest = elements["least"], elements["greatest"]
    for sensor, places in _sensors(facts, len(least)):
        if all(least[i] == greatest[i] for i in places):
            yield Finding(
                "constant",
                f"{name}: {sensor} never changes",
                f"its {len(places)} elements were the same {seen}",
                "is it filled in (CollectObservations, AddObservation in the order of the specs), and do its "
                "objects exist in every area?",
            )

    if facts["same_for_all"]:
        yield Finding(
            "same for all",
            f"{name}: all agents see the same",
            "in every round their observations were equal, though they change with time",
            "observe from the agent's own place (transform.localPosition, not another object's)",
        )
    yield from _scales(evidence, name, facts)


def _scales(evidence: Evidence, name: str, facts: Facts) -> Iterator[Finding]:
    elements = facts["elements"]
    least, greatest = elements["least"], elements["greatest"]
    is_normalized = evidence.option("model.normalize_obs", name) == "true"
    cure = "model.normalize_obs=true, or divide by the largest value in the game"

    huge = [i for i in range(len(least)) if max(-least[i], greatest[i]) > _HUGE]
    if huge and not is_normalized:
        i = max(huge, key=lambda i: max(-least[i], greatest[i]))
        yield Finding(
            "huge",
            f"{name}: observations are huge",
            f"{_elements(facts, huge)}: up to {amount(max(-least[i], greatest[i]))}",
            cure,
        )

    moving = [i for i in range(len(least)) if least[i] < greatest[i]]
    if moving and not is_normalized and all(greatest[i] - least[i] < _TINY for i in moving):
        widest = max(greatest[i] - least[i] for i in moving)
        yield Finding(
            "tiny",
            f"{name}: observations hardly change",
            f"none moves by more than {amount(widest)}",
            cure,
        )

    # a ray that meets nothing, or begins inside something, stands at an end as it should
    rays = {i for sensor, places in _sensors(facts, len(least)) if "RayPerception" in sensor for i in places}
    clipped = [i for i in elements["clipped"] if i not in rays]
    if clipped:
        share = f"{elements['clipped_share']:.0%} of values stand at an end"
        yield Finding(
            "clipped",
            f"{name}: observations are clipped",
            f"{_elements(facts, clipped)}: {share}",
            "divide by a larger value before clipping: what lies beyond cannot be told apart",
        )


def _masks(name: str, facts: Facts) -> Iterator[Finding]:
    if leaves_one_action(facts):
        yield Finding(
            "one action",
            f"{name}: masks leave one action",
            f"in {facts['one_action']:.0%} of decisions nothing else was allowed",
            "WriteDiscreteActionMask: SetActionEnabled(branch, action, true) allows an action again",
        )
    elif facts["never_allowed"]:
        names = ", ".join(str(i) for i in facts["never_allowed"][:_SHOWN])
        yield Finding(
            "never allowed",
            f"{name}: some actions are never allowed",
            f"counted over all branches: {names}",
            "WriteDiscreteActionMask: is the condition ever true? Or make the branch smaller",
        )


def _agents(name: str, facts: Facts) -> Iterator[Finding]:
    slots = facts["slots"]
    if slots["idle"] > _IDLE * slots["all"]:
        yield Finding(
            "idle agents",
            f"{name}: agents are there, but hardly ever asked",
            f"{slots['idle']} of {slots['all']} made fewer than one decision in 500 rounds",
            "do they end their episodes (EndEpisode) or ask again (RequestDecision, DecisionRequester)?",
        )


def _episodes(name: str, facts: Facts) -> Iterator[Finding]:
    episodes, slots = facts["episodes"], facts["slots"]["all"]
    if not episodes["count"] and slots and facts["decisions"] >= 2_000 * slots:
        yield Finding(
            "never ends",
            f"{name}: episodes never end",
            f"no end in {amount(facts['decisions'] / slots)} decisions of each agent",
            "give the Agent a Max Step, or call EndEpisode; without ends there are no returns to compare",
        )
    if episodes["count"] >= 50 and episodes["of_one_decision"] > 0.5 * episodes["count"]:
        yield Finding(
            "ends at once",
            f"{name}: episodes end with their first decision",
            f"{episodes['of_one_decision'] / episodes['count']:.0%} of {amount(episodes['count'])}",
            "is the scene reset in OnEpisodeBegin, and is Max Step more than one decision period?",
        )


def _rewards(evidence: Evidence, name: str, facts: Facts, is_long: bool) -> Iterator[Finding]:
    rewards, episodes = facts["rewards"], facts["episodes"]
    if not rewards["nonzero"]:
        if is_long:
            yield Finding(
                "no reward",
                f"{name}: there was never a reward",
                f"0 in {amount(facts['decisions'])} decisions, {amount(episodes['count'])} episodes",
                "is AddReward (AddGroupReward) called? "
                f"If it is far to find: {_ways_to_find(evidence, name)}",
            )
        return

    # a policy that was trained before may earn all that there is
    is_same = episodes["count"] >= 50 and episodes["greatest"] - episodes["least"] < 1e-6
    if is_same and is_long and not evidence.has_risen:
        yield Finding(
            "equal returns",
            f"{name}: every episode earns the same",
            f"{amount(episodes['least'])} in each of {amount(episodes['count'])}",
            f"reward what the agent does; if its goal was never met: {_ways_to_find(evidence, name)}",
        )

    largest = max(-rewards["least"], rewards["greatest"])
    if largest > _HUGE_RETURN and evidence.option("ppo.normalize_values", name) == "none":
        yield Finding(
            "huge rewards",
            f"{name}: rewards are huge, and values are not normalised",
            f"up to {amount(largest)}",
            "ppo.normalize_values=popart, or rewards of about 1",
        )


def _ways_to_find(evidence: Evidence, name: str) -> str:
    """Return what helps to a goal that is never met, but for what the run has already."""
    ways = "a curriculum, or demonstrations (bc.demos)"
    if any(evidence.number(f"rewards.{stream}.strength", name) > 0 for stream in ("rnd", "curiosity")):
        return f"novelty is rewarded already and may need longer; else {ways}"
    return f"rewards.rnd.strength=0.1, rewards.curiosity.strength=0.1, {ways}"


def _sensors(facts: Facts, size: int) -> Iterator[tuple[str, range]]:
    """Yield each vector sensor's name and its elements; one for all where they do not add up."""
    sizes = [length for _, length in facts["vectors"]]
    if sum(sizes) != size:
        yield "the vector observation", range(size)
        return

    start = 0
    for sensor, length in facts["vectors"]:
        yield f"sensor {sensor or 'without a name'}", range(start, start + length)
        start += length


def _elements(facts: Facts, found: list[int]) -> str:
    """Return which elements were found, by sensor: ``sensor Vector[0, 3, 5, ...]``."""
    size = len(facts["elements"]["least"])
    parts = []
    for sensor, places in _sensors(facts, size):
        inside = [i - places.start for i in found if i in places]
        if inside:
            more = ", ..." if len(inside) > _SHOWN else ""
            parts.append(f"{sensor}[{', '.join(map(str, inside[:_SHOWN]))}{more}]")
    return "; ".join(parts[:_SHOWN])
