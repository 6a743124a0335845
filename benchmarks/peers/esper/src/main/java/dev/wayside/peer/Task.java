package dev.wayside.peer;

/** What is measured: samples and ticks go in, episodes start and end. */
interface Task {
    /** Parses the payload of a sample and sends it as an event. */
    void take(Recording.Sample sample) throws java.io.IOException;

    /** Runs a tick; all samples up to its time are in. Milliseconds on the clock of Esper. */
    void tick(long tick);

    /** Moves the clock to just before a tick, where the samples of that tick enter. */
    void before(long tick);

    /** Forgets all open episodes and counts; windows are empty already. */
    void reset();

    long starts();

    long ends();
}
