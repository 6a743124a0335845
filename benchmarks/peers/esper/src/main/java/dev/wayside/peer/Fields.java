package dev.wayside.peer;

import com.fasterxml.jackson.core.JsonFactory;
import com.fasterxml.jackson.core.JsonParser;
import com.fasterxml.jackson.core.JsonToken;
import com.fasterxml.jackson.core.StreamReadFeature;
import java.io.IOException;
import java.util.Arrays;
import java.util.HashMap;
import java.util.Map;

/** Reads numbers from payloads and clients from keys. */
final class Fields {
    private static final JsonFactory JSON =
            JsonFactory.builder().enable(StreamReadFeature.USE_FAST_DOUBLE_PARSER).build();

    private final Map<String, Integer> clients = new HashMap<>();

    /** The number of the client that a key vehicles/CLIENT/STREAM names, counted from 0 as they appear. */
    int client(String key) {
        Integer known = clients.get(key);
        if (known == null) {
            known = clients.size();
            clients.put(key, known);
        }
        return known;
    }

    /** Reads the fields of a flat message; NaN where one is absent. */
    static void read(byte[] payload, String[] names, double[] values) throws IOException {
        Arrays.fill(values, Double.NaN);
        try (JsonParser parser = JSON.createParser(payload)) {
            parser.nextToken();
            while (parser.nextToken() == JsonToken.FIELD_NAME) {
                String name = parser.currentName();
                parser.nextToken();
                for (int i = 0; i < names.length; i++) {
                    if (names[i].equals(name)) {
                        values[i] = parser.getDoubleValue();
                    }
                }
                parser.skipChildren();
            }
        }
    }
}
