package dev.wayside.peer;

import com.fasterxml.jackson.core.JsonFactory;
import com.fasterxml.jackson.core.JsonParser;
import com.fasterxml.jackson.core.JsonToken;
import java.io.BufferedReader;
import java.io.IOException;
import java.nio.charset.StandardCharsets;
import java.nio.file.Files;
import java.nio.file.Path;
import java.util.ArrayList;
import java.util.Arrays;
import java.util.HashMap;
import java.util.List;
import java.util.Map;

/** A recording of JSON lines in memory; the payloads stay bytes. */
final class Recording {
    /** One message: its time in nanoseconds, its key, and its payload as it came. */
    record Sample(long time, String key, byte[] payload) {
    }

    /** In order of time. */
    final List<Sample> samples;

    private Recording(List<Sample> samples) {
        this.samples = samples;
    }

    /** Reads lines of the form {"t": nanoseconds, "key": text, "value": payload}. */
    static Recording read(Path path) throws IOException {
        JsonFactory json = new JsonFactory();
        List<Sample> samples = new ArrayList<>();
        Map<String, String> keys = new HashMap<>();
        try (BufferedReader lines = Files.newBufferedReader(path)) {
            for (String line = lines.readLine(); line != null; line = lines.readLine()) {
                samples.add(sample(json, line, keys));
            }
        }
        return new Recording(samples);
    }

    private static Sample sample(JsonFactory json, String line, Map<String, String> keys) throws IOException {
        byte[] bytes = line.getBytes(StandardCharsets.UTF_8);
        long time = 0;
        String key = null;
        byte[] payload = null;
        try (JsonParser parser = json.createParser(bytes)) {
            parser.nextToken();
            while (parser.nextToken() == JsonToken.FIELD_NAME) {
                String name = parser.currentName();
                parser.nextToken();
                switch (name) {
                    case "t" -> time = parser.getLongValue();
                    case "key" -> key = keys.computeIfAbsent(parser.getText(), text -> text);
                    case "value" -> {
                        int begin = (int) parser.currentTokenLocation().getByteOffset();
                        parser.skipChildren();
                        int end = (int) parser.currentLocation().getByteOffset();
                        payload = Arrays.copyOfRange(bytes, begin, end);
                    }
                    default -> throw new IOException("unknown field " + name);
                }
            }
        }
        if (key == null || payload == null) {
            throw new IOException("a line lacks key or value: " + line);
        }
        return new Sample(time, key, payload);
    }
}
